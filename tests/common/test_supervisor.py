"""A thread that fails ends its process with an error, as soon as what it had open is closed; none dies silently."""

import os
import subprocess
import sys
import textwrap
import threading

import pytest

from common.supervisor import EXIT_CODE, ThreadEndedError, supervised_threads, until

HEAD = """
import signal, sys, threading, time
from common.supervisor import supervised_threads, until

def fail():
    raise OverflowError("int too big")

def start(work):
    threading.Thread(target=work, name="ingest", daemon=True).start()
"""


def run(body: str) -> subprocess.CompletedProcess[str]:
    program = HEAD + textwrap.dedent(body)
    return subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        env=os.environ,
    )


def test_a_failed_thread_ends_a_process_that_waits_for_a_signal_and_lets_it_close() -> None:
    done = run("""
        stop = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        with supervised_threads():
            start(fail)
            stop.wait(20.0)
            print("closed", flush=True)
        print("not reached")
    """)
    assert (done.returncode, done.stdout) == (EXIT_CODE, "closed\n")
    assert "thread 'ingest' failed" in done.stderr
    assert "OverflowError" in done.stderr


def test_a_fault_of_the_main_thread_ends_with_the_same_code_and_names_its_place() -> None:
    done = run("""
        with supervised_threads():
            fail()
    """)
    assert done.returncode == EXIT_CODE
    assert "in fail" in done.stderr
    assert "OverflowError: int too big" in done.stderr


def test_a_process_that_hangs_or_heeds_no_signal_ends_too() -> None:
    hangs = run("""
        signal.signal(signal.SIGTERM, lambda *_: None)
        with supervised_threads():
            start(fail)
            time.sleep(20.0)
            print("not reached")
    """)
    heedless = run("""
        with supervised_threads():
            start(fail)
            time.sleep(20.0)
            print("not reached")
    """)
    for done in (hangs, heedless):
        assert (done.returncode, done.stdout) == (EXIT_CODE, "")


def test_a_thread_that_returns_too_early_has_failed() -> None:
    done = run("""
        with supervised_threads():
            start(until(lambda: False, lambda: None))
            time.sleep(20.0)
    """)
    assert done.returncode == EXIT_CODE
    assert "before it was asked to stop" in done.stderr


def test_the_planted_failure_is_what_ends_it() -> None:
    done = run("""
        with supervised_threads():
            start(until(lambda: True, lambda: None))
            time.sleep(0.3)
    """)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_stopped_thread_may_return() -> None:
    until(lambda: True, lambda: None)()
    with pytest.raises(ThreadEndedError):
        until(lambda: False, lambda: None)()


def test_the_block_leaves_the_hook_as_it_was() -> None:
    before = threading.excepthook
    with supervised_threads() as supervisor:
        assert threading.excepthook == supervisor.thread_failed
    assert threading.excepthook is before
