"""The hand for mink (differential inverse kinematics on MuJoCo, Apache-2.0), where it is installed: an optional peer.

The model is written from the hand's profile: one body per joint and axis, hinges with the profile's limits, the DIP
coupled to the PIP by an equality, a site for every marker. Tasks bring the sites to the caps; the limits are mink's
own; steps are repeated until they end. `pip install mink` brings all it needs (qpsolvers with daqp, mujoco).
"""

import importlib
import importlib.util
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from bench.hand_draws import MARKERS
from common.arrays import Float
from common.geometry.transforms import matrix_to_quaternion, rigid
from common.hand.model import CHAINS, FINGERS, HandModel

INSTALL = "not installed (pip install mink)"
_ANGLES = ("abduction", "flexion", "pip", "dip")
_STEPS = 100
_STILL_RAD = 1e-5  # a step this small (also in metres) is the last
_DAMPING = 1e-9


def installed() -> bool:
    """Whether mink can be imported."""
    return importlib.util.find_spec("mink") is not None


def hand_mjcf(model: HandModel, *, free_palm: bool) -> str:
    """The hand as MuJoCo XML: joints `index_pip` ..., sites named like the markers; `free_palm`: it floats."""
    fingers = "".join(_finger(model, f) for f in range(5))
    back = _site("back", model.mount("back").offset_m)
    coupled = ""
    if model.dip_per_pip is not None:
        coupled = "".join(
            f'<joint joint1="{finger}_dip" joint2="{finger}_pip" polycoef="0 {model.dip_per_pip!r} 0 0 0"/>'
            for finger in FINGERS[1:]
        )
    floating = '<freejoint name="palm"/>' if free_palm else ""
    return (
        '<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>'
        f'<body name="palm">{floating}{_MASS}{back}{fingers}</body>'
        f"</worldbody><equality>{coupled}</equality></mujoco>"
    )


_MASS = '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'  # bodies must have one; nothing moves by it


def _finger(model: HandModel, f: int) -> str:
    """Nested bodies: abduction, flexion (at one place), PIP, DIP. Rest turns as in `common.hand.model`."""
    name, root = FINGERS[f], CHAINS[f, 0]
    rest, still = model.rest_rotation[root], np.eye(3)
    before, after = (rest, still) if f == 0 else (still, rest)  # the thumb abducts about its own axis
    places = (model.rest_position_m[root], np.zeros(3), *model.bone_m[f, :2])
    rotations = (before, after, *model.link_rotation[f, :2])
    axes = ((0.0, model.side_sign, 0.0), *[(-1.0, 0.0, 0.0)] * 3)
    mount = model.mount(MARKERS[f])
    inner = _site(MARKERS[f], model.bone_m[f, 2] + model.link_rotation[f, 2] @ mount.offset_m)
    for k in (3, 2, 1, 0):
        low, high = model.limits_rad[f, k].tolist()
        joint = ""
        if low < high:  # a joint without room is none
            joint = (
                f'<joint name="{name}_{_ANGLES[k]}" axis="{_numbers(np.array(axes[k]))}" limited="true"'
                f' range="{low!r} {high!r}"/>'
            )
        quaternion = _numbers(matrix_to_quaternion(rotations[k]))
        inner = f'<body pos="{_numbers(places[k])}" quat="{quaternion}">{joint}{_MASS}{inner}</body>'
    return inner


def _site(name: str, place: Float) -> str:
    return f'<site name={quoteattr(name)} pos="{_numbers(place)}"/>'


def _numbers(values: Float) -> str:
    return " ".join(repr(float(v)) for v in values)


class MinkHand:
    """Warm differential inverse kinematics. Holds the configuration, from which the next search starts."""

    def __init__(
        self,
        model: HandModel,
        *,
        weight: Float | None = None,
        posture: tuple[Float, Float] | None = None,
    ) -> None:
        """Build the model and its tasks.

        Args:
            model: The hand.
            weight: None: the palm is at the origin and the five tips are to be hit. Else the palm floats, and this is
                one per sigma (3,) [1/m] of a cap along the rig's axes, which must be alike.
            posture: Mean (5, 4) [rad] and one per sigma (5, 4) [1/rad] of a belief about the angles, or None.

        Raises:
            ModuleNotFoundError: mink is not installed.
        """
        mink, mujoco = importlib.import_module("mink"), importlib.import_module("mujoco")
        free = weight is not None
        self._mink: Any = mink
        self._mujoco = mujoco.MjModel.from_xml_string(hand_mjcf(model, free_palm=free))
        self._hand = mink.Configuration(self._mujoco)
        cost = 1.0 if weight is None else float(weight.mean())
        self._names = MARKERS if free else MARKERS[:5]
        self._points = [mink.FrameTask(name, "site", cost, 0.0) for name in self._names]
        self._tasks: list[Any] = [*self._points]
        self._columns = np.full((5, 4), -1)
        for f, finger in enumerate(FINGERS):
            for k, angle in enumerate(_ANGLES):
                joint = mujoco.mj_name2id(self._mujoco, mujoco.mjtObj.mjOBJ_JOINT, f"{finger}_{angle}")
                if joint >= 0:
                    self._columns[f, k] = self._mujoco.jnt_qposadr[joint]
        if posture is not None:
            self._tasks.append(self._prior(*posture))
        self._limits = [mink.ConfigurationLimit(self._mujoco, gain=1.0)]
        self._equal = [mink.EqualityConstraintTask(self._mujoco, 1.0)] if self._mujoco.neq else None
        self._low, self._high = model.limits_rad[..., 0], model.limits_rad[..., 1]
        self._free = free

    def _prior(self, mean: Float, per_sigma: Float) -> Any:
        q, cost = self._hand.q.copy(), np.zeros(self._mujoco.nv)
        has = self._columns >= 0
        q[self._columns[has]] = mean[has]
        shift = self._mujoco.nq - self._mujoco.nv  # a floating palm has seven numbers and six velocities
        cost[self._columns[has] - shift] = per_sigma[has]
        task = self._mink.PostureTask(self._mujoco, cost)
        task.set_target(q)
        return task

    def begin(self, T_rig_palm: Float, angles_rad: Float) -> None:
        """Start the next search from a palm (4, 4) and angles (5, 4) [rad]."""
        q = self._hand.q.copy()
        has = self._columns >= 0
        q[self._columns[has]] = angles_rad[has]
        if self._free:
            q[:3], q[3:7] = T_rig_palm[:3, 3], matrix_to_quaternion(T_rig_palm[:3, :3])
        self._hand.update(q)

    def push(self, points_m: Float) -> tuple[Float, Float]:
        """Palm (4, 4) and angles (5, 4) [rad] for caps (M, 3) [m]; with a fixed palm in its frame."""
        for _ in range(_STEPS):
            for task, name, point in zip(self._points, self._names, points_m, strict=False):
                # The target turns with the site: only its place is asked for.
                R_target = self._hand.get_transform_frame_to_world(name, "site").rotation()
                task.set_target(self._mink.SE3.from_rotation_and_translation(R_target, point))
            step = self._mink.solve_ik(
                self._hand,
                self._tasks,
                1.0,
                solver="daqp",
                damping=_DAMPING,
                limits=self._limits,
                constraints=self._equal,
            )
            self._hand.integrate_inplace(step, 1.0)
            if np.abs(step).max() < _STILL_RAD:
                break
        return self._pose()

    def _pose(self) -> tuple[Float, Float]:
        q = self._hand.q
        angles = np.where(self._columns >= 0, q[self._columns], self._low)
        if not self._free:
            return np.eye(4), angles
        site = self._hand.get_transform_frame_to_world("palm", "body")
        return rigid(site.rotation().as_matrix(), site.translation()), angles
