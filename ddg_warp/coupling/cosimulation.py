"""Staggered co-simulation of rods and shells with a robot in MuJoCo, by grips and wrenches."""

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import replace

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.coupling.mujoco_model import body_of, compiled, mujoco_module, start_data
from ddg_warp.errors import SceneError
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.model import check_model
from ddg_warp.model.state import State, check_state
from ddg_warp.scene.descriptions import supports_of
from ddg_warp.scene.grip import Grip
from ddg_warp.solve.stepping.integrator import Integrator
from ddg_warp.solve.stepping.wrenches import Reactions

TOLERANCE = 1e-4  # relative change of the wrenches that ends the iterations of a step


class MuJoCo:
    """Staggered co-simulation of a model with a MuJoCo model.

        sim = ddg.coupling.MuJoCo(model, "arm.xml", attach={"hand": "tip"})
        for state in sim.run(2.0, dt=0.002):
            sim.data.ctrl[:] = policy(state, sim.data)

    In each step MuJoCo advances first, under the wrenches of the last step. The poses of its bodies then move the grips of the model
    over the step, and the wrenches of the grips become the wrenches of the next step. Bodies of MuJoCo do not include the masses of the
    nodes that a grip holds: these arrive with the wrenches.

    The scheme is of first order in the step. Without iterations it is stable as long as a link is heavier than the length of rod that
    bending waves reach in a step. With iterations it is stable for light links, too.

    Measured: a hinged link that holds a rod of 20 edges converges with the step like the monolithic solution, with and without damping.
    It does so without iterations for links of 0.5 to 2.2 times the mass of the rod at 1 to 8 ms, and of 0.2 times at 1 and 2 ms. With
    iterations links of 0.02 times the mass converge at 1 to 8 ms, by 4 iterations a step at 1 ms, and 15 at 8 ms.

    Args:
        model: of one world.
        mj_model: `MjModel`, or path or text of an MJCF or URDF file.
        attach: names of bodies, sites or geoms of MuJoCo, by `Grip` or by the name of a support or obstacle with a `Grip`. A grip moves
            rigidly with the body that carries the named object.
        data: `MjData` of the start, copied; the initial configuration by default.
        state: start of the model, with its grips where MuJoCo's bodies are in `data`; the initial state by default.
        control: function of `MjData`, called before each step of MuJoCo, also of repeated ones, to set `ctrl`.
        iterations: largest number of repetitions of a step until wrenches agree with poses to 1e-4, for light links; 1 does not repeat.
        options: of the `Integrator`.

    Attributes:
        model, mj_model: the models.
        integrator: of the model.
        state: of the model.
        data: `MjData`. Rows of `xfrc_applied` of attached bodies belong to the coupling; add own loads by `qfrc_applied`.
        reactions: `Reactions` of supports, grips and obstacles in the last step, on the model.

    Raises:
        SceneError: a name is unknown, a support has no grip, the model has several worlds, or options do not fit.
        MissingPackageError: the package mujoco is missing.
    """

    def __init__(
        self,
        model,
        mj_model,
        attach: Mapping[Grip | str, str],
        *,
        data=None,
        state: State | None = None,
        control: Callable | None = None,
        iterations: int = 1,
        **options,
    ):
        call = "coupling.MuJoCo"
        check_model(call, model)
        if model.worlds != 1:
            raise SceneError(f"{call}: the model has {model.worlds} worlds; build it with worlds=1")
        if control is not None and not callable(control):
            raise SceneError(f"{call}: control is {argument_checks.shown(control)}; give a function of MjData")
        self._mujoco, self.iterations = mujoco_module(), argument_checks.count(f"{call}: iterations", iterations)
        self.model, self.mj_model, self.control = model, compiled(call, mj_model), control
        self._start = start_data(call, self.mj_model, data), model.state() if state is None else state
        check_state(call, model, self._start[1])
        self._bodies = _attached(call, model, self.mj_model, attach)
        grips = {id(model.grips[index]): body for index, body in self._bodies.items()}
        self._rows = sorted(set(self._bodies.values()))
        self._owners = [
            (i, grips[id(s.motion)]) for i, s in enumerate(supports_of(model.scene)) if id(s.motion) in grips
        ]
        self._first = self._start[1].poses()  # of grips at the start
        self.integrator = Integrator(model, **options)
        self.integrator.watch_wrenches()
        self.data = copy(self._start[0])
        self.reset()

    def __repr__(self) -> str:
        return f"<MuJoCo coupling at t = {self.data.time:g} s: {len(self._bodies)} grips of {self.model!r}>"

    def reset(self) -> State:
        """Return to the start of both models; return its state."""
        start, self.state = self._start
        self._restore(self._saved(start))
        self._mujoco.mj_forward(self.mj_model, self.data)
        self.reactions: Reactions = self.model.reactions(self.state)
        self._wrenches = self._reversed()
        return self.state

    def step(self, dt: float, controls: Controls | None = None) -> State:
        """Advance both models by dt [s]; return the state of the model.

        Args:
            dt: a multiple of MuJoCo's time step [s].
            controls: further controls of the model. Their poses are of grips that are not attached.

        Raises:
            SceneError: dt is no multiple of MuJoCo's time step, or controls do not fit.
            SolverError: the step failed, as of `Integrator.step`; `reset` starts again.
        """
        substeps = self._substeps(dt)
        controls = Controls() if controls is None else controls
        poses = self.state.poses() if controls.poses is None else checked(controls, self.model)["poses"][0]
        before, applied, tried = self._saved(self.data), self._wrenches, []
        for iteration in range(self.iterations):
            if iteration:
                self._restore(before)
            self.data.xfrc_applied[self._rows] = applied
            for _ in range(substeps):
                if self.control is not None:
                    self.control(self.data)
                self._mujoco.mj_step(self.mj_model, self.data)
            self._mujoco.mj_kinematics(self.mj_model, self.data)
            state = self.integrator.step(self.state, dt, replace(controls, poses=self._poses(poses)))
            self.reactions = self.integrator.wrenches()
            self._wrenches = self._reversed()
            tried.append((applied, self._wrenches - applied))
            if np.abs(tried[-1][1]).max() <= TOLERANCE * np.abs(self._wrenches).max():
                break
            applied = _accelerated(tried)
        self.state = state
        return state

    def run(self, duration: float, dt: float, controls: Controls | None = None) -> Iterator[State]:
        """Yield the state after each step of dt [s], over a duration [s]; `step` has the arguments."""
        duration = argument_checks.positive("run: duration", duration, "s")
        self._substeps(dt)
        for _ in range(max(round(duration / dt), 1)):
            yield self.step(dt, controls)

    def _substeps(self, dt: float) -> int:
        """Return the number of MuJoCo's steps in dt; refuse fractions."""
        dt, timestep = argument_checks.positive("dt", dt, "s"), self.mj_model.opt.timestep
        substeps = round(dt / timestep)
        if substeps < 1 or abs(substeps * timestep - dt) > 1e-6 * timestep:
            raise SceneError(
                f"coupling.MuJoCo: dt = {dt:g} s is no multiple of MuJoCo's time step, {timestep:g} s; give one, or set opt.timestep"
            )
        return substeps

    def _saved(self, data) -> np.ndarray:
        """Return all variables of MuJoCo's data that the next step depends on."""
        variables = self._mujoco.mjtState.mjSTATE_INTEGRATION
        values = np.zeros(self._mujoco.mj_stateSize(self.mj_model, variables))
        self._mujoco.mj_getState(self.mj_model, data, values, variables)
        return values

    def _restore(self, values: np.ndarray) -> None:
        """Set MuJoCo's data to saved variables."""
        self._mujoco.mj_setState(self.mj_model, self.data, values, self._mujoco.mjtState.mjSTATE_INTEGRATION)

    def _reversed(self) -> np.ndarray:
        """Return force and moment about the centre of mass of the model on each attached body (bodies, 6)."""
        wrenches = np.zeros((len(self._rows), 6))
        for support, body in self._owners:
            reaction, row = self.reactions[support], wrenches[self._rows.index(body)]
            row[:3] -= reaction.force
            row[3:] -= reaction.moment + np.cross(reaction.point - self.data.xipos[body], reaction.force)
        return wrenches

    def _poses(self, poses: np.ndarray) -> np.ndarray:
        """Return the poses of all grips (grips, 6): attached ones follow MuJoCo's bodies."""
        poses, before, start = poses.copy(), self.state.poses(), self._start[0]
        turn, inverse, arm = np.zeros(4), np.zeros(4), np.zeros(3)
        for index, body in self._bodies.items():
            grip, first, rotation = self.model.grips[index], self._first[index], np.array([1.0, 0.0, 0.0, 0.0])
            self._mujoco.mju_negQuat(inverse, start.xquat[body])
            self._mujoco.mju_mulQuat(turn, self.data.xquat[body], inverse)
            self._mujoco.mju_rotVecQuat(arm, first[:3] + grip.pivot - start.xpos[body], turn)
            self._mujoco.mju_quatIntegrate(rotation, first[3:], 1.0)
            self._mujoco.mju_mulQuat(turn, turn.copy(), rotation)
            poses[index] = grip.at(self.data.xpos[body] + arm, turn, near=before[index])
        return poses


def _accelerated(tried: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the next wrenches of a fixed-point iteration by Anderson acceleration.

    Args:
        tried: wrenches and residuals of all iterations of the step.

    Source: Degroote, Bathe, Vierendeels 2009, interface quasi-Newton by least squares.
    """
    wrenches, residuals = (np.array([values.ravel() for values in each]) for each in zip(*tried, strict=True))
    last = wrenches[-1] + (0.5 if len(tried) == 1 else 1.0) * residuals[-1]
    if len(tried) > 1:
        changes, gains = (values[:-1] - values[-1] for values in (residuals, wrenches + residuals))
        last = last + gains.T @ np.linalg.lstsq(changes.T, -residuals[-1])[0]
    return last.reshape(tried[0][0].shape)


def _attached(call: str, model, mj_model, attach) -> dict[int, int]:
    """Return the body of MuJoCo of each attached grip, by index among the grips of the model.

    Raises:
        SceneError: an entry names no grip, or nothing of MuJoCo.
    """
    if not isinstance(attach, Mapping) or not attach:
        raise SceneError(
            f"{call}: attach is {argument_checks.shown(attach)}; give names of MuJoCo's bodies by grip, as {{'hand': 'tip'}}"
        )
    scene, bodies = model.scene, {}
    for key, name in attach.items():
        motion = key if isinstance(key, Grip) else _grip_named(call, scene, key)
        if motion not in model.grips:
            raise SceneError(f"{call}: attach: {argument_checks.shown(key)} holds nothing of the model")
        index = model.grips.index(motion)
        if index in bodies:
            raise SceneError(f"{call}: attach: {argument_checks.shown(key)} is attached twice")
        bodies[index] = body_of(f"{call}: attach", mj_model, name)
    return bodies


def _grip_named(call: str, scene, name) -> Grip:
    """Return the grip of the supports or obstacles of a name."""
    supports = supports_of(scene)
    if type(name) is not str:
        raise SceneError(
            f"{call}: attach: {argument_checks.shown(name)}; give a Grip, or the name of a support or obstacle"
        )
    grips = {id(s.motion): s.motion for s in supports if s.name == name and isinstance(s.motion, Grip)}
    if len(grips) != 1:
        names = [s.name for s in supports if isinstance(s.motion, Grip) and s.name]
        reason = f"{len(grips)} grips have the name {name!r}" if grips else f"no grip holds a support named {name!r}"
        raise SceneError(f"{call}: attach: {reason}{argument_checks.meant(name, names)}")
    return next(iter(grips.values()))
