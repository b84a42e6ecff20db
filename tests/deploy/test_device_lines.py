"""What a device prints while it is deployed to reaches the operator's terminal as text, and steers nothing there."""

import sys

from deploy.remote import Terminal, run_bounded

STEERS = "title \x1b]0;owned\x07 clear \x1b[2J c1 \x9b2J right to left \u202e tab\tend"


def test_lines_of_a_device_have_no_control_characters() -> None:
    program = f"import sys; sys.stdout.reconfigure(encoding='utf-8'); print({STEERS!r}); sys.exit({STEERS!r})"
    lines: list[str] = []
    code, errors = run_bounded([sys.executable, "-X", "utf8", "-c", program], b"", lines.append, 60.0)
    assert code == 1
    for line in (*lines, *errors):
        assert line == "title ?]0;owned? clear ?[2J c1 ?2J right to left ? tab\tend"
    assert len(lines) == len(errors) == 1


def test_what_a_device_says_in_its_answer_is_printed_as_text_too() -> None:
    lines: list[str] = []
    Terminal(lines.append).notify("left: \x1b[31mstreaming")
    assert lines == ["left: ?[31mstreaming"]
