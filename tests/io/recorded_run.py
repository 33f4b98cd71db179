"""Recorded runs of models, for tests of files."""

from pathlib import Path

import ddg_warp as ddg
from ddg_warp.io.hdf5 import TrajectoryReader


def record(model, folder, steps: int, dt: float, resume: bool = False, **options) -> list:
    """Record the states up to a number of steps, of a run that begins or resumes; return the states."""
    integrator, state = ddg.Integrator(model), model.state()
    with ddg.Recorder(model, folder, block=2, resume=resume, **options) as recorder:
        if resume:
            with TrajectoryReader(Path(folder) / "trajectory.h5") as reader:
                state = model.restore(reader.checkpoint())
        recorder.record(state)
        states = [state.copy()]
        while round(state.time / dt) < steps:
            state = integrator.step(state, dt)
            recorder.record(state)
            states.append(state.copy())
    return states
