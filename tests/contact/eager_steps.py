"""Steps that are not captured, so that what happens in them can be watched."""


def eagerly(integrator, state, dt):
    """Launch a step, in which all pairs have room; the buffers that it ends in."""
    source = integrator._own(state)
    integrator._vacate(1 - source)
    integrator._prepare(dt, state)
    for part in integrator._parts:
        part.prescribe(state.time, state.time + dt)
    integrator._launch(source)
    assert not integrator._net.outgrown(integrator._buffers[source].own.net)
    return integrator._buffers[1 - source]
