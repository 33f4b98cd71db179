"""Parameters of any shape read by the same code: one number, per rod, per element, per rod and element; and worlds."""

import numpy as np
import pytest

import ddg_warp as ddg

RODS, NODES = 3, 8
RANDOM = np.random.default_rng(2)
FORMS = {
    "number": 1.0,
    "per rod": RANDOM.uniform(0.7, 1.3, size=(RODS, 1)),
    "per element": RANDOM.uniform(0.7, 1.3, size=NODES - 1),
    "each": RANDOM.uniform(0.7, 1.3, size=(RODS, NODES - 1)),
}
STRIDES = {"number": (0, 0), "per rod": (0, 1), "per element": (1, 0), "each": (RODS, 1)}
KINDS = {"full": {}, "untwisted": {"twist": False}, "planar": {"dimension": 2}, "stretch": {"bend": False}}


def build(device, scale=1.0, kind="full", worlds=1, viscosity=0.0):
    """Return three cantilevers of random rest lengths, with all sections `scale` times a common one."""
    options = dict(KINDS[kind])
    dimension = options.pop("dimension", 3)
    across = 1.0 if dimension == 3 else 0.0
    scene = ddg.Scene(gravity=(0.0, across, -9.81), dimension=dimension)
    points = np.zeros((RODS, NODES, 3))
    points[..., 0] = np.cumsum(np.random.default_rng(3).uniform(0.05, 0.15, size=NODES))
    section = ddg.Stiffness(
        EA=200.0 * scale,
        EI1=0.02 * scale,
        EI2=(0.03 if kind == "full" else 0.02) * scale,
        GJ=0.01 * scale,
        mass_per_length=0.3 * scale,
        rotary_inertia=1e-5 * scale,
        viscosity=viscosity * scale,
    )
    rods = scene.add_rods(points, section=section, natural="straight", **options)
    scene.clamp(rods, edges=[0])
    scene.add_force(rods, NODES - 1, (0.1, 0.05 * across, 0.0))
    return scene.build(device=device, precision="float64", worlds=worlds)


def simulate(model, steps=5):
    """Return points and angles after some steps."""
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, 0.01)
    return state.points(), state.angles()


def set_parameters(model, change):
    """Replace every row of the parameter table by change(row, nodes, rods)."""
    for group in model.groups:
        values = group.parameters.values
        values |= {name: change(v, group.nodes, group.columns) for name, v in values.items()}
        group.parameters.upload()  # keeps their forms, where `set` would expand them to the previous shapes
    return model


def expand(model):
    """Expand every parameter to one value per element."""
    return set_parameters(model, lambda values, nodes, rods: np.broadcast_to(values, (nodes, rods)).copy())


def assert_same(first, second):
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("form", STRIDES)
@pytest.mark.parametrize("viscosity", [0.0, 0.01], ids=["elastic", "damped"])
def test_every_stride_reads_the_same(device, form, viscosity):
    """All rows in one form, rest measures and rest strains included, equal the expanded values."""

    def in_form(values, nodes, rods):
        shape = (nodes if STRIDES[form][0] else 1, rods if STRIDES[form][1] else 1)
        return values[:1, :1] * np.random.default_rng(4).uniform(0.9, 1.1, size=shape)

    model = set_parameters(build(device, viscosity=viscosity), in_form)
    expanded = expand(set_parameters(build(device, viscosity=viscosity), in_form))
    (group,), (full,) = model.groups, expanded.groups
    assert (group.parameters.table.numpy()[:, 1:] == STRIDES[form]).all()
    assert (full.parameters.table.numpy()[:, 1:] == STRIDES["each"]).all()
    assert_same(simulate(model), simulate(expanded))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("viscosity", [0.0, 0.01], ids=["elastic", "damped"])
def test_shape_of_section_does_not_matter(device, form, viscosity):
    """A section in one form equals the same section given for each element of each rod."""
    every = np.broadcast_to(FORMS[form], (RODS, NODES - 1)).copy()
    model, written_out = (build(device, scale, viscosity=viscosity) for scale in (FORMS[form], every))
    points, angles = simulate(model)
    assert_same((points, angles), simulate(written_out))
    assert_same((points, angles), simulate(expand(model)))
    assert np.abs(points - model.state().points()).max() > 0.01  # the rods moved


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_reads_every_shape(device, kind):
    for form, scale in FORMS.items():
        points, _ = simulate(build(device, scale, kind))
        expanded, _ = simulate(expand(build(device, scale, kind)))
        np.testing.assert_array_equal(points, expanded, err_msg=form)


def test_parameters_belong_to_their_rod(device):
    """Each rod moves as if all rods had the parameters of that rod; rods with different parameters differ."""
    each = FORMS["each"]
    together, _ = simulate(build(device, each))
    together = together.reshape(RODS, NODES, 3)
    for rod in range(RODS):
        single, _ = simulate(build(device, each[rod]))  # all three rods with the parameters of this one
        np.testing.assert_allclose(single.reshape(RODS, NODES, 3)[rod], together[rod], rtol=0, atol=1e-14)
    assert np.abs(together[0] - together[1]).max() > 1e-6


@pytest.mark.parametrize("form", FORMS)
def test_worlds_are_bitwise_equal(device, form):
    scale = FORMS[form]
    points, angles = simulate(build(device, scale, worlds=3))
    assert points.shape == (3, RODS * NODES, 3)
    single, alone_angles = simulate(build(device, scale))
    for world in range(3):
        np.testing.assert_array_equal(points[world], single)
        np.testing.assert_array_equal(angles[world], alone_angles)


@pytest.mark.parametrize("kind", ["untwisted", "planar", "stretch"])
def test_worlds_of_other_kinds(device, kind):
    points, _ = simulate(build(device, FORMS["each"], kind, worlds=3))
    single, _ = simulate(build(device, FORMS["each"], kind))
    for world in range(3):
        np.testing.assert_array_equal(points[world], single)
