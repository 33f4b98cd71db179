"""Questions about objects in contact, as in `questions`."""

import numpy as np
from objects import add_floor, ignore_pairs_of_objects
from questions import Variant, _mass, assert_close, body_masses

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.solve.equilibrium.continuation import Continuation

STEP, COUNT = 2e-3, 8


def _fall_onto_floor(kind, variant, velocities, gravity: float, motion=None, controls=None, **options) -> tuple:
    """Step an unsupported object onto a floor with checks at every step; return the last state and the integrator."""
    scene, _ = kind.scene(held=False, gravity=(0.0, 0.0, -gravity))
    add_floor(scene, 2e-3, motion, **options)
    model = variant.build(scene)
    integrator = ddg.Integrator(model, rtol=1e-9)
    speed = np.zeros((variant.worlds, model.points_count, 3)) + velocities[:, None]
    state, pair_count = model.state(velocities=speed if variant.worlds > 1 else speed[0]), 0
    mass, bodies = _mass(model), body_masses(model)
    total = mass.sum() + bodies.sum()

    def momentum(state) -> np.ndarray:
        """Return the momentum (worlds, 3) of points and bodies."""
        of_bodies = [m * variant.each(state.body(k).velocity) for k, m in enumerate(bodies)]
        return sum(of_bodies, (mass[:, None] * variant.each(state.velocities())).sum(1))

    for k in range(1, COUNT + 1):
        before = momentum(state)
        state = integrator.step(state, STEP, controls and controls(k))
        force = (momentum(state) - before) / STEP + total * np.array([0.0, 0.0, gravity])
        floor_force = variant.each(model.reactions(state)[-1].force)
        assert_close(
            floor_force[:, 2], force[:, 2], rtol=1e-6, atol=1e-6 * total, message="the floor carries what it stops"
        )
        pairs = model.contacts(state)
        summed = np.zeros((variant.worlds, 3))
        np.add.at(
            summed, pairs.world, pairs.force + pairs.friction
        )  # floors come last: the first object feels the force
        assert_close(summed, floor_force, rtol=1e-9, atol=1e-12, message="contacts are what the floor does")
        assert (pairs.gap > 0.0).all()
        energy = variant.each(model.energies(state)["contact"])
        assert ((energy > 0.0) == (floor_force[:, 2] > 0.0)).all()
        pair_count += len(pairs)
    assert pair_count, "nothing touched"
    statistics = integrator.statistics()
    assert statistics["contact"]["refused_crossings"] == 0
    assert set(statistics["outcomes"]) <= {"converged", "converged_to_rounding"}, statistics["outcomes"]
    assert statistics["contact"]["friction_work"] >= 0.0
    return state, integrator


def contact(kind, variant):
    """A falling object transfers to the floor the momentum that contact takes; each world equals a single one."""
    speeds = np.array([[0.2, 0.0, -0.5 - 0.1 * w] for w in range(variant.worlds)])
    state, _ = _fall_onto_floor(kind, variant, speeds, 5.0)
    for world, points in enumerate(variant.each(state.points())):
        alone, _ = _fall_onto_floor(kind, Variant(variant.device, variant.precision), speeds[world : world + 1], 5.0)
        assert_close(points, alone.points(), atol=1e-8)


def rolls(kind, variant):
    """Rolling contact spins the rods of an object that slides over a floor; each world equals a single one."""
    speeds = np.array([[0.2, 0.3, -0.5 - 0.1 * w] for w in range(variant.worlds)])
    state, _ = _fall_onto_floor(kind, variant, speeds, 5.0, rolling=True)
    smooth, _ = _fall_onto_floor(kind, variant, speeds, 5.0)
    rotation = variant.each(state.angles()) - variant.each(smooth.angles())
    assert (np.abs(rotation).max(1) > 1e-4).all()
    for world, points in enumerate(variant.each(state.points())):
        alone, _ = _fall_onto_floor(
            kind, Variant(variant.device, variant.precision), speeds[world : world + 1], 5.0, rolling=True
        )
        assert_close(points, alone.points(), atol=1e-8)


def moved_obstacle(kind, variant):
    """A floor lifted by a grip acts as one lifted by a prescribed motion, in every world."""
    rates, none = 0.5 + 0.1 * np.arange(variant.worlds), np.zeros((variant.worlds, 3))

    def controls(k):
        poses = np.zeros((variant.worlds, 1, 6))
        poses[:, 0, 2] = k * STEP * rates
        return ddg.Controls(poses)

    state, _ = _fall_onto_floor(kind, variant, none, 1.0, ddg.Grip(), controls)
    for world, points in enumerate(variant.each(state.points())):
        motion = ddg.Motion(lambda t, rate=rates[world]: (0.0, 0.0, rate * t))
        alone, _ = _fall_onto_floor(kind, Variant(variant.device, variant.precision), none[:1], 1.0, motion)
        assert_close(points, alone.points(), atol=1e-8)


def _scene_over_ball(kind, variant):
    """Return a scene with a ball under the point of largest sag, at half of the sag under full weight."""
    weighed = {"gravity": (0.0, 0.0, -0.5)}
    free, _ = kind.scene(**weighed)
    model = variant.build(free)
    rest = variant.each(model.state().points())[0]
    sag = variant.each(statics.solve(model).points())[0] - rest
    row = int(np.argmin(sag[:, 2]))
    scene, _ = kind.scene(**weighed)
    thick = [np.max(batch.section.radius) for batch in scene.batches]
    offset = 0.005 + max(thick + [0.5 * np.max(shell.thickness) for shell in scene.shells], default=0.0)
    centre = rest[row] + np.array([0.0, 0.0, 0.95 * sag[row, 2] - offset])
    scene.add_obstacle(ddg.Sphere(tuple(centre), 0.005), name="ball")
    scene.contact(range=-0.2 * sag[row, 2])
    ignore_pairs_of_objects(scene)
    return scene


def rests(kind, variant):
    """An object that hangs down onto a ball: supports and ball carry its weight, in each world as in a single one."""
    scene = _scene_over_ball(kind, variant)
    model = variant.build(scene)
    state = statics.solve(model)
    pairs, forces = model.contacts(state), [variant.each(reaction.force) for reaction in model.reactions(state)]
    ball_force, weight = np.zeros((variant.worlds, 3)), 0.5 * (_mass(model).sum() + body_masses(model).sum())
    first = pairs.objects[:, :1] == len(pairs.names) - 1  # the ball: opposite force
    np.add.at(ball_force, pairs.world, np.where(first, -pairs.force, pairs.force))
    assert (pairs.gap > 0.0).all()
    assert (ball_force[:, 2] > 1e-3 * weight).all()
    assert_close(ball_force, forces[-1], rtol=1e-9, atol=1e-12, message="contacts are what the ball does")
    assert_close(sum(forces)[:, 2], weight, rtol=1e-5, message="supports and the ball carry the weight")
    assert (variant.each(model.energies(state)["contact"]) > 0.0).all()
    alone = scene.build(variant.device, variant.precision)
    heights = variant.each(state.points())[..., 2]  # a standing rod without bending may lean anywhere
    assert_close(heights, np.tile(statics.solve(alone).points()[:, 2], (variant.worlds, 1)), atol=1e-8)


def path_onto_a_ball(kind, variant):
    """A path of equilibria under growing weight ends on the ball, at the result of load stepping."""
    model = variant.build(_scene_over_ball(kind, variant))
    path = Continuation(model).trace(stop=ddg.StopCriterion(load=(-1.0, 1.0)))
    first, last = path.points[0], path.points[-1]
    before, after = (model.reactions(point.state)[-1].force[2] for point in (first, last))
    assert last.load == 1.0
    assert last.stable
    assert 0.0 <= before < after
    assert_close(last.state.points()[:, 2], statics.solve(model).points()[:, 2], atol=1e-8)


CONTACT_QUESTIONS = {
    "contact": contact,
    "rolls": rolls,
    "moved obstacle": moved_obstacle,
    "rests": rests,
    "path onto a ball": path_onto_a_ball,
}
