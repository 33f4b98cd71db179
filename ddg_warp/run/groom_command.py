"""Command `ddg-warp groom`: flags, and the call of `simulate_groom`."""

import argparse
from pathlib import Path

from ddg_warp.run.scene_registry import refused


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `ddg-warp groom`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a .usd, .usda, .usdc or .usdz file")
    parser.add_argument("--prim", metavar="PATH", help="curves to simulate, with all below (default: the whole file)")
    parser.add_argument("--skin", metavar="PATH", help="mesh that the curves grow from")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="LAYER", help="the layer to write, .usd, .usda or .usdc"
    )
    parser.add_argument(
        "--samples", default="interpolating", help="nodes of cubic curves: interpolating, vertices, or a number"
    )
    parser.add_argument("--substeps", type=int, default=4, metavar="N", help="time steps of a frame (default: 4)")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="frames after the first (default: to the last time code)"
    )
    for name, unit, help_text in (
        ("young", "Pa", "Young's modulus, a number or a primvar (default: 2e9)"),
        ("radius", "M", "radius, a number or a primvar (default: half the widths)"),
        ("curl", "1/M", "natural curvature, a number or a primvar (default: as drawn)"),
        ("twist", "1/M", "natural twist, a number or a primvar (default: as drawn)"),
    ):
        parser.add_argument(f"--{name}", type=_number_or_name, metavar=unit, help=help_text)
    for name, unit, help_text in (
        ("density", "KG/M^3", "density (default: 1300)"),
        ("damping", "1/S", "damping by the air (default: 1)"),
        ("friction", "MU", "coefficient of friction (default: 0.2)"),
        ("root-length", "M", "length from the root without contact with the skin (default: until clear of it)"),
    ):
        parser.add_argument(f"--{name}", type=float, metavar=unit, help=help_text)
    parser.add_argument("--group", metavar="PRIMVAR", help="primvar whose values are the groups")
    parser.add_argument("--sag-free", action="store_true", help="rest shapes with which strands at rest hang as drawn")
    parser.add_argument("--self-contact", action="store_true", help="strands collide with each other, too")
    parser.add_argument("--outside", action="store_true", help="allow references out of the folder of the file")


def run_groom(chosen: argparse.Namespace) -> int:
    """Run `ddg-warp groom`."""
    from ddg_warp.run.groom import simulate_groom

    names = ("young", "radius", "curl", "twist", "density", "damping", "friction", "root_length", "group")
    options = {name: getattr(chosen, name) for name in names if getattr(chosen, name) is not None}
    with refused():
        result = simulate_groom(
            chosen.file,
            chosen.prim,
            out=chosen.out,
            skin=chosen.skin,
            samples=int(chosen.samples) if chosen.samples.isdigit() else chosen.samples,
            substeps=chosen.substeps,
            frames=chosen.frames,
            device=chosen.device,
            precision=chosen.precision,
            outside=chosen.outside,
            sag_free=chosen.sag_free,
            self_contact=chosen.self_contact,
            **options,
        )
    for line in result.groom.unread:
        print(f"not read: {line}")
    if chosen.frames is None and result.state.time == 0.0:
        print("the stage has one time code, so that nothing moved; --frames N simulates frames after it")
    print(f"{len(result.groom.counts)} strands, {result.state.time:g} s: {result.path}")
    return 0


def _number_or_name(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
