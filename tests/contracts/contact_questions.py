"""What is asked of objects in contact: questions as those of `questions`."""

import numpy as np
from objects import over_floor, pass_each_other
from questions import Variant, _mass, close

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.solve.continuation import Continuation

STEP, COUNT = 2e-3, 8


def _hits(kind, variant, velocities, gravity: float, motion=None, controls=None, **options) -> tuple:
    """Steps of an object without supports over a floor, with what is true at each of them; the last state and the integrator."""
    scene, _ = kind.scene(held=False, gravity=(0.0, 0.0, -gravity))
    over_floor(scene, 2e-3, motion, **options)
    model = variant.build(scene)
    integrator = ddg.Integrator(model, rtol=1e-9)
    speed = np.zeros((variant.worlds, model.points_count, 3)) + velocities[:, None]
    state, mass, touched = model.state(velocities=speed if variant.worlds > 1 else speed[0]), _mass(model), 0
    for k in range(1, COUNT + 1):
        before = variant.each(state.velocities())
        state = integrator.step(state, STEP, controls and controls(k))
        after = variant.each(state.velocities())
        force = (mass[:, None] * (after - before)).sum(1) / STEP + mass.sum() * np.array([0.0, 0.0, gravity])
        pushed = variant.each(model.reactions(state)[-1].force)
        close(pushed[:, 2], force[:, 2], rtol=1e-6, atol=1e-6 * mass.sum(), what="the floor carries what it stops")
        found = model.contacts(state)
        summed = np.zeros((variant.worlds, 3))
        np.add.at(summed, found.world, found.force + found.friction)  # floors come last: the first is pushed
        close(summed, pushed, rtol=1e-9, atol=1e-12, what="contacts are what the floor does")
        assert (found.gap > 0.0).all()
        energy = variant.each(model.energies(state)["contact"])
        assert ((energy > 0.0) == (pushed[:, 2] > 0.0)).all()
        touched += len(found)
    assert touched, "nothing touched"
    statistics = integrator.statistics()
    assert statistics["contact"]["refused_crossings"] == 0
    assert set(statistics["outcomes"]) <= {"converged", "converged_to_rounding"}, statistics["outcomes"]
    assert statistics["contact"]["friction_work"] >= 0.0
    return state, integrator


def contact(kind, variant):
    """What falls onto a floor pushes it with what the floor takes of its momentum; worlds are as alone."""
    speeds = np.array([[0.2, 0.0, -0.5 - 0.1 * w] for w in range(variant.worlds)])
    state, _ = _hits(kind, variant, speeds, 5.0)
    for world, points in enumerate(variant.each(state.points())):
        alone, _ = _hits(kind, Variant(variant.device, variant.precision), speeds[world : world + 1], 5.0)
        close(points, alone.points(), atol=1e-8)


def rolls(kind, variant):
    """What falls onto a floor, and slides over it, is turned about the axes of its rods; worlds are as alone."""
    speeds = np.array([[0.2, 0.3, -0.5 - 0.1 * w] for w in range(variant.worlds)])
    state, _ = _hits(kind, variant, speeds, 5.0, rolling=True)
    smooth, _ = _hits(kind, variant, speeds, 5.0)
    turned = variant.each(state.angles()) - variant.each(smooth.angles())
    assert (np.abs(turned).max(1) > 1e-4).all()
    for world, points in enumerate(variant.each(state.points())):
        alone, _ = _hits(kind, Variant(variant.device, variant.precision), speeds[world : world + 1], 5.0, rolling=True)
        close(points, alone.points(), atol=1e-8)


def moved_obstacle(kind, variant):
    """A floor that a grip lifts in every world pushes as one that a motion lifts at that rate."""
    rates, none = 0.5 + 0.1 * np.arange(variant.worlds), np.zeros((variant.worlds, 3))

    def controls(k):
        poses = np.zeros((variant.worlds, 1, 6))
        poses[:, 0, 2] = k * STEP * rates
        return ddg.Controls(poses)

    state, _ = _hits(kind, variant, none, 1.0, ddg.Grip(), controls)
    for world, points in enumerate(variant.each(state.points())):
        motion = ddg.Motion(lambda t, rate=rates[world]: (0.0, 0.0, rate * t))
        alone, _ = _hits(kind, Variant(variant.device, variant.precision), none[:1], 1.0, motion)
        close(points, alone.points(), atol=1e-8)


def _over_ball(kind, variant):
    """A scene with a ball below what hangs down under half of its weight, where it sinks the most."""
    weighed = {"gravity": (0.0, 0.0, -0.5)}
    free, _ = kind.scene(**weighed)
    model = variant.build(free)
    rest = variant.each(model.state().points())[0]
    sag = variant.each(statics.solve(model).points())[0] - rest
    row = int(np.argmin(sag[:, 2]))
    scene, _ = kind.scene(**weighed)
    thick = [np.max(batch.section.radius) for batch in scene.batches]
    apart = 0.005 + max(thick + [0.5 * np.max(shell.thickness) for shell in scene.shells], default=0.0)
    centre = rest[row] + np.array([0.0, 0.0, 0.95 * sag[row, 2] - apart])
    scene.add_obstacle(ddg.Sphere(tuple(centre), 0.005), name="ball")
    scene.contact(range=-0.2 * sag[row, 2])
    pass_each_other(scene)
    return scene


def rests(kind, variant):
    """What hangs down onto a ball rests on it: supports and ball carry its weight, in every world as alone."""
    scene = _over_ball(kind, variant)
    model = variant.build(scene)
    state = statics.solve(model)
    found, forces = model.contacts(state), [variant.each(reaction.force) for reaction in model.reactions(state)]
    pushed, weight = np.zeros((variant.worlds, 3)), 0.5 * _mass(model).sum()
    first = found.objects[:, :1] == len(found.names) - 1  # the ball, whose force is the opposite
    np.add.at(pushed, found.world, np.where(first, -found.force, found.force))
    assert (found.gap > 0.0).all()
    assert (pushed[:, 2] > 1e-3 * weight).all()
    close(pushed, forces[-1], rtol=1e-9, atol=1e-12, what="contacts are what the ball does")
    close(sum(forces)[:, 2], weight, rtol=1e-5, what="supports and the ball carry the weight")
    assert (variant.each(model.energies(state)["contact"]) > 0.0).all()
    alone = scene.build(variant.device, variant.precision)
    heights = variant.each(state.points())[..., 2]  # a chain that stands may lean any way
    close(heights, np.tile(statics.solve(alone).points()[:, 2], (variant.worlds, 1)), atol=1e-8)


def path_onto_a_ball(kind, variant):
    """A path of equilibria under growing weight leads onto the ball, where load steps lead to."""
    model = variant.build(_over_ball(kind, variant))
    path = Continuation(model).trace(stop=ddg.Stop(load=(-1.0, 1.0)))
    first, last = path.points[0], path.points[-1]
    before, pushed = (model.reactions(point.state)[-1].force[2] for point in (first, last))
    assert last.load == 1.0
    assert last.stable
    assert 0.0 <= before < pushed
    close(last.state.points()[:, 2], statics.solve(model).points()[:, 2], atol=1e-8)


CONTACT_QUESTIONS = {
    "contact": contact,
    "rolls": rolls,
    "moved obstacle": moved_obstacle,
    "rests": rests,
    "path onto a ball": path_onto_a_ball,
}
