"""The OSC output: what arrives at a socket, read by a decoder of the specification."""

import socket

import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration.output_settings import OscOutput
from common.errors import PhalanxError
from common.hand.model import FINGERS, JOINTS
from common.messages import Contact, Gesture, ResultMessage
from master.outputs.network.conventions import MasterTimes
from master.outputs.network.osc import Blank, BlankBundle, OscSink, floats, ints
from tests.master.outputs.network.hands import hand_pose
from tests.master.outputs.network.osc_reader import Received, packet_of
from tests.results import object_pose

T_NS, NTP_1970_S = 5_000_000_000, 2_208_988_800
WALL_NS = 1_700_000_000_250_000_000  # at the master's 0


def sent(ear: socket.socket, *messages: ResultMessage) -> list[Received]:
    """What arrives when these are sent, of all datagrams."""
    now_ns = T_NS + 10_000_000
    times = MasterTimes(lambda: now_ns, lambda: WALL_NS + now_ns)
    sink = OscSink(OscOutput(port=ear.getsockname()[1]), times)
    for message in messages:
        sink.write(message)
    sink.close()
    sink.close()
    return [received for _ in messages for received in packet_of(ear.recv(65536))]


def test_a_hand_is_one_bundle_of_its_joints_and_angles_at_its_time(ear: socket.socket) -> None:
    angles = np.arange(20.0).reshape(5, 4) / 40.0
    pose = hand_pose("right", angles, np.array([0.4, -0.2, 0.9]))
    received = {one.address: one for one in sent(ear, pose)}
    joints = [f"/phalanx/hand/right/{joint}" for joint in JOINTS]
    fingers = [f"/phalanx/hand/right/{finger}/angles" for finger in FINGERS]
    assert list(received) == ["/phalanx/hand/right/frame", *joints, *fingers]
    assert received["/phalanx/hand/right/frame"].arguments == ("my-right", 1, pytest.approx(0.012))
    for row, joint in enumerate(joints):
        w, x, y, z = pose.orientation_wxyz[row]
        np.testing.assert_allclose(
            received[joint].numbers, [*pose.position_m[row], x, y, z, w, 1], rtol=1e-6, atol=1e-7
        )
    for row, finger in enumerate(fingers):
        np.testing.assert_allclose(received[finger].numbers, angles[row], rtol=1e-6)
    assert {one.at_s for one in received.values()} == {1_700_000_005.25 + NTP_1970_S}


def test_what_is_not_known_has_no_message_and_a_left_hand_is_left(ear: socket.socket) -> None:
    pose = hand_pose("left")
    valid, tracked, position = pose.valid.copy(), pose.tracked.copy(), pose.position_m.copy()
    valid[7], position[8], tracked[[7, 9]] = False, np.nan, False
    angles = pose.angles_rad.copy()
    angles[1] = np.nan
    known = replace(pose, valid=valid, tracked=tracked, position_m=position, angles_rad=angles)
    received = {one.address: one.arguments for one in sent(ear, known)}
    missing = {f"/phalanx/hand/left/{JOINTS[row]}" for row in (7, 8)} | {"/phalanx/hand/left/index/angles"}
    assert len(received) == 32 - len(missing)
    assert not missing & set(received)
    assert received[f"/phalanx/hand/left/{JOINTS[9]}"][7] == 0


def test_objects_contact_and_gestures_have_addresses_of_their_own(ear: socket.socket) -> None:
    wand = object_pose("wand", [0.1, 0.2, 0.3], [0.5, 0.5, -0.5, 0.5], t_ns=T_NS)
    touch = np.array([True, False, False, False, True])
    contact = Contact(
        "me", "wand", T_NS, np.arange(5) / 8, np.ones(5), np.zeros((5, 3)), touch, 0.25, held=True
    )
    pinch = Gesture("me", T_NS, "pinch", "index", "begin", T_NS, 0.75, 0.5, 0.25, origin_m=np.ones(3))
    received = sent(ear, wand, contact, pinch)
    assert [one.address for one in received] == [
        "/phalanx/object/wand",
        "/phalanx/contact/wand",
        "/phalanx/gesture/pinch",
    ]
    np.testing.assert_allclose(received[0].numbers, [0.1, 0.2, 0.3, 0.5, -0.5, 0.5, 0.5, 1], rtol=1e-6)
    assert received[1].arguments == ("me", 1, 1, 0, 0, 0, 1, 0.25, 0.0, 0.125, 0.25, 0.375, 0.5)
    assert received[2].arguments[:6] == ("me", "index", "begin", 0.75, 0.5, 0.25)
    np.testing.assert_array_equal(received[2].numbers[3:], [np.nan, 1, 1, 1, np.nan, np.nan, np.nan])


def test_a_hand_or_object_of_which_nothing_is_known_is_not_sent(ear: socket.socket) -> None:
    nowhere = object_pose("wand", [np.nan] * 3, [np.nan] * 4, source=0, tracked=False, seen=0)
    lost = replace(hand_pose("left"), position_m=np.full((26, 3), np.nan))
    sink = OscSink(OscOutput(port=ear.getsockname()[1]), MasterTimes())
    for message in (nowhere, lost, hand_pose("left")):
        sink.write(message)
    assert packet_of(ear.recv(65536))[0].arguments[1] == 1  # the first to come is the third message


def test_a_host_that_is_none_is_named_with_its_key() -> None:
    with pytest.raises(PhalanxError, match=r"no-such-host\.invalid:9000: no such host.*osc\.host"):
        OscSink(OscOutput(host="no-such-host.invalid"), MasterTimes())


def test_numbers_are_filled_in_behind_texts_of_any_length() -> None:
    blanks = [Blank("/" + "a" * n, ("t" * n, "u"), "fi") for n in range(1, 10)]
    rows = np.stack([floats(np.arange(9) / 4), ints(np.arange(9) - 4)], axis=1)
    received = packet_of(BlankBundle(blanks).filled(0, rows.ravel()))
    assert [one.arguments for one in received] == [("t" * n, "u", (n - 1) / 4, n - 5) for n in range(1, 10)]
    assert {one.at_s for one in received} == {float(NTP_1970_S)}
    some = np.arange(9) % 2 == 0
    few = packet_of(BlankBundle(blanks).filled(0, rows.ravel(), some))
    assert few == received[::2]
