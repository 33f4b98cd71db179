"""Steps without graph capture, so that tests can observe the stages."""


def step_without_capture(integrator, state, dt):
    """Launch a step without capture and return the buffers of the end; candidate lists must have room."""
    source = integrator._own(state)
    integrator._vacate(1 - source)
    integrator._prepare(dt, state)
    for stepper in integrator._parts:
        stepper.prescribe(state.time, state.time + dt)
    integrator._launch(source)
    assert not integrator._coupled.has_overflow(integrator._buffers[source].own.coupled)
    return integrator._buffers[1 - source]
