"""Mutation check: put faults into a copy of the source, one after the other, and see if the fast tests find each.

    python tools/mutants.py [NAME ...] [--list] [--whole] [--out DIR]

A fault replaces a text that occurs once in its file: a sign, an index, a factor, a dropped term. Most change results or Hessians.
Faults of the line search, the edge-rotation update and the joint Schur complement change iterates or a preconditioner alone. Tests
compare these directly. `tests` of a fault are files, most specific first, that run until the first failure. A test finds a fault if
it fails with the fault and passes without.

--list prints the faults. --whole runs all fast tests if the files of a fault do not find it. Tests run in a temporary copy of
the tracked files, with links to the kernel cache, so that neither this checkout nor its cache changes. Writes mutants.csv and .json.
Exit status 1 if more than one fault is not found.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from ddg_warp.run.summary import machine, table, write_table

ROOT = Path(__file__).resolve().parent.parent
MISSED = "NOT FOUND"
MAX_MISSED = 1  # largest number of faults that are not found
TIME_LIMIT, WHOLE_LIMIT = 600, 3600  # of test files and of all fast tests [s]; the limit finds an endless loop


@dataclass(frozen=True)
class Fault:
    """Fault in a file: replaces the only occurrence of `old` by `new`; `tests` are the files that should find it."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def check(self, root: Path) -> None:
        """Refuse an old text that does not occur exactly once, and tests that do not exist."""
        count = (root / self.file).read_text().count(self.old)
        if count != 1:
            raise ValueError(f"{self.name}: the old text occurs {count} times in {self.file}; it has to occur once")
        for test in self.tests:
            if not (root / test).is_file():
                raise ValueError(f"{self.name}: there is no {test}")


FAULTS = (
    # strain measures
    Fault(
        "second curvature: sign in the Jacobian",
        "kernels/measures/rod_curvature_twist.py",
        "k2e = -wp.cross(tf, s1) * ic",
        "k2e = wp.cross(tf, s1) * ic",
        ("tests/kernels/test_terms.py", "tests/kernels/test_chain.py"),
    ),
    Fault(
        "curvature and twist: lengthening dropped from the second derivative",
        "kernels/measures/rod_curvature_twist.py",
        " + lengthening(te, turn_e + b * m3 - ze * moment_e, inverse_e)",
        "",
        ("tests/kernels/test_terms.py", "tests/linear/test_psd.py"),
    ),
    Fault(
        "hinge angle: sign of the derivative by the edge",
        "kernels/measures/hinge_angle.py",
        "de = -(da * wp.dot(a, e) + db * wp.dot(b, e))",
        "de = (da * wp.dot(a, e) + db * wp.dot(b, e))",
        ("tests/kernels/test_shell_measures.py", "tests/kernels/test_terms.py"),
    ),
    Fault(
        "mid-edge normal: whole instead of half the dihedral angle",
        "kernels/measures/midedge_curvature.py",
        "phi = xi + real(0.5) * angle(e, a, b)",
        "phi = xi + angle(e, a, b)",
        ("tests/kernels/test_shell_measures.py", "tests/kernels/test_terms.py"),
    ),
    # energy densities
    Fault(
        "log barrier: factor in the second derivative",
        "kernels/densities/contact.py",
        "left * (left + real(4.0))",
        "left * (left + real(2.0))",
        ("tests/kernels/test_contact_laws.py",),
    ),
    Fault(
        "friction: sign of the tangent along the slip",
        "kernels/densities/friction.py",
        "wp.outer(unit, unit) * (along - across)",
        "wp.outer(unit, unit) * (across - along)",
        ("tests/kernels/test_contact_laws.py",),
    ),
    Fault(
        "friction: tangent along the slip as across it",
        "kernels/densities/friction.py",
        "scale * force(x), scale * slope_of(x), wp.normalize(u)",
        "scale * force(x), scale * force(x), wp.normalize(u)",
        ("tests/collision/test_friction_statics.py",),
    ),
    # elements
    Fault(
        "parallel transport: sense of rotation",
        "kernels/elements/parallel_transport.py",
        "d * c + wp.cross(b, d)",
        "d * c - wp.cross(b, d)",
        ("tests/kernels/test_frames.py",),
    ),
    Fault(
        "assembly: both nodes of an edge swapped",
        "kernels/elements/coupled_element.py",
        "return up - down",
        "return down - up",
        ("tests/linear/test_rod_substructuring.py",),
    ),
    Fault(
        "parameters: row of the parameter before",
        "kernels/elements/element_path.py",
        "p[i] = one(inputs, wp.static(first + 1) + i, island, e)",
        "p[i] = one(inputs, wp.static(first) + i, island, e)",
        ("tests/test_parameters.py", "tests/test_quantities.py"),
    ),
    # residual and Newton's method
    Fault(
        "residual: sign of rotary inertia",
        "kernels/residual/rod_residual.py",
        "moment -= elastic + c * spin * (theta",
        "moment -= elastic - c * spin * (theta",
        ("tests/kernels/test_chain.py", "tests/linear/test_partitioned.py"),
    ),
    Fault(
        "line search: sign of Armijo's constant",
        "kernels/newton/rod_sweep.py",
        "real(-1.0e-4) * expected",
        "real(1.0e-4) * expected",
        ("tests/kernels/test_chain.py",),
    ),
    Fault(
        "line search from sums: sign of Armijo's constant",
        "kernels/newton/line_search.py",
        "real(-1.0e-4) * expected",
        "real(1.0e-4) * expected",
        ("tests/kernels/test_line_search.py",),
    ),
    Fault(
        "edge-rotation update: mismatch spread over one edge too many",
        "kernels/newton/edge_rotation.py",
        "slope = miss / real(stop - i)",
        "slope = miss / real(stop - i + 1)",
        ("tests/linear/test_partitioned.py", "tests/test_edge_rotation_steps.py"),
    ),
    # linear algebra
    Fault(
        "LDL^T: entry of another row in the back substitution",
        "kernels/linear/block_ldlt.py",
        "u1 = Z[1] * inverse[1] - L[2, 1] * u2 - L[3, 1] * u3",
        "u1 = Z[1] * inverse[1] - L[2, 1] * u2 - L[3, 2] * u3",
        ("tests/kernels/test_pivot.py",),
    ),
    Fault(
        "bands of the coupled system: missing transpose",
        "kernels/linear/rod_bands.py",
        "y[i] = y[i] + m[j, i] * u[j]",
        "y[i] = y[i] + m[i, j] * u[j]",
        ("tests/linear/test_rod_substructuring.py",),
    ),
    Fault(
        "joint Schur complement: sign",
        "kernels/linear/joint_schur.py",
        "(bb + wp.transpose(bb)) - wp.transpose(ab) * Q",
        "(bb + wp.transpose(bb)) + wp.transpose(ab) * Q",
        ("tests/linear/test_rod_substructuring.py",),
    ),
    # time stepping and forces
    Fault(
        "energy drift: sign of the work of stresses",
        "kernels/stepping/energy_drift.py",
        "B(end - start - w * wp.dot(slope, strain)",
        "B(end - start + w * wp.dot(slope, strain)",
        ("tests/test_midpoint_energy.py",),
    ),
    Fault(
        "predictor: mass damping dropped from the inertia coefficient",
        "kernels/stepping/time_step.py",
        "coefficient = rate * (rate + damping[0])",
        "coefficient = rate * rate",
        ("tests/test_edge_rotation_steps.py", "tests/adjoint/test_adjoint.py"),
    ),
    Fault(
        "drag: tangential and normal coefficient swapped",
        "kernels/forces/drag.py",
        "(one * normal + wp.outer(t, t) * (tangential - normal))",
        "(one * tangential + wp.outer(t, t) * (normal - tangential))",
        ("tests/test_drag.py",),
    ),
    Fault(
        "quadratic drag: half of the derivative along the normal",
        "kernels/forces/drag.py",
        "wp.outer(t, t) * (real(2.0) * wp.abs(wp.dot(v, t)))",
        "wp.outer(t, t) * wp.abs(wp.dot(v, t))",
        ("tests/test_wind.py",),
    ),
    Fault(
        "field of flow: taken where nodes start by the midpoint rule, too",
        "kernels/forces/flow.py",
        "velocity(lift(x[k, r] + v[k, r] * lead[0]), modes, phases)",
        "velocity(lift(x[k, r]), modes, phases)",
        ("tests/test_wind.py",),
    ),
    Fault(
        "drag of shells: gradient by the first corner of a triangle",
        "kernels/adjoint/shell_drag.py",
        "position_out[0, t, island] = -by_a - by_b",
        "position_out[0, t, island] = -by_a",
        ("tests/adjoint/test_adjoint.py",),
    ),
    Fault(
        "gyroscopic couple: sign at one node",
        "kernels/forces/gyroscopic.py",
        "vb + wp.cw_mul(inverse_b, push)",
        "vb - wp.cw_mul(inverse_b, push)",
        ("tests/test_gyroscopic.py",),
    ),
    # collisions
    Fault(
        "additive CCD: minimum separation dropped",
        "kernels/collision/ccd/additive_ccd.py",
        "gap = distance(x, q, t + step) - thickness",
        "gap = distance(x, q, t + step)",
        ("tests/collision/test_additive_ccd.py",),
    ),
    Fault(
        "geometric stiffness of contact: change of the second parameter",
        "kernels/collision/contact/geometric_stiffness.py",
        "b1 = wp.dot(e1, s) + wp.dot(r, total(c1, v))",
        "b1 = wp.dot(e1, s)",
        ("tests/collision/test_pair_terms.py",),
    ),
    Fault(
        "rolling friction: sign of the second lever",
        "kernels/collision/friction/potential.py",
        "wp.matrix_from_rows(wp.cross(t, n) * a, wp.cross(u, n) * b)",
        "wp.matrix_from_rows(wp.cross(t, n) * a, wp.cross(n, u) * b)",
        ("tests/collision/test_rolling.py",),
    ),
    # adjoint
    Fault(
        "adjoint of a step: velocity at the end dropped",
        "kernels/adjoint/time_step.py",
        "v -= ended - velocity",
        "v += velocity",
        ("tests/adjoint/test_adjoint.py",),
    ),
    Fault(
        "adjoint of friction: lagged positions and start swapped",
        "ddg_warp/adjoint/contact.py",
        "zip(written, (grad_q, by_before, by_lagged), strict=True)",
        "zip(written, (grad_q, by_lagged, by_before), strict=True)",
        ("tests/adjoint/test_contact_adjoint.py",),
    ),
    # host: compilation, solvers, post-processing
    Fault(
        "Voronoi length of a clamped end: whole edge",
        "ddg_warp/compile/rods.py",
        "voronoi[:, 0] = 0.5 * lengths[:, 1]",
        "voronoi[:, 0] = lengths[:, 1]",
        ("tests/test_clamped_ends.py", "tests/test_quantities.py"),
    ),
    Fault(
        "ghost nodes: edges have mass",
        "ddg_warp/compile/rods.py",
        "rod_lengths[:, real] = lengths[:, real]",
        "rod_lengths[:] = lengths",
        ("tests/test_statics.py", "tests/test_quantities.py"),
    ),
    Fault(
        "couple: factor in the load stiffness",
        "ddg_warp/compile/loads.py",
        "pair = (cross - 2.0 * (e @ cross.T)",
        "pair = (cross - (e @ cross.T)",
        ("tests/test_edge_rotation_of_rods.py",),
    ),
    Fault(
        "bordered system: sign of the load",
        "ddg_warp/solve/linear/bordered.py",
        "sparse.csc_matrix(-self._load_scale * column[:, None])",
        "sparse.csc_matrix(self._load_scale * column[:, None])",
        ("tests/test_continuation.py",),
    ),
    Fault(
        "friction Jacobian: derivative of normal forces dropped",
        "ddg_warp/solve/equilibrium/friction_jacobian.py",
        "by_x[:PAIR_NODES] += by_lagged[:PAIR_NODES]",
        "by_x[:PAIR_NODES] += 0.0 * by_lagged[:PAIR_NODES]",
        ("tests/adjoint/test_contact_equilibria.py",),
    ),
    Fault(
        "end moments: directors of the inner edge instead of the clamp",
        "ddg_warp/postprocess/end_moments.py",
        "((first[k + e, column], t[k + e, column]) for e in (ghost, edge))",
        "((first[k + e, column], t[k + e, column]) for e in (edge, ghost))",
        ("tests/test_clamped_ends.py",),
    ),
)


class Copy:
    """Copy of the tracked files in a temporary folder, with its own view of the kernel cache, in which tests run."""

    def __init__(self, folder: Path):
        import warp as wp

        wp.init()
        self.root, cache = folder / "source", folder / "cache"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for name in filter(None, listed.split("\0")):
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)
        for package in ("kernels", "scenes"):  # as the package's own finder resolves them
            (self.root / "ddg_warp" / package).symlink_to(self.root / package)
        unfinished = shutil.ignore_patterns("*_p[0-9]*_t[0-9]*")  # folders in which other processes compile
        shutil.copytree(wp.config.kernel_cache_dir, cache, copy_function=_link, ignore=unfinished)
        self.environment = os.environ | {
            "PYTHONPATH": str(self.root),
            "PYTHONDONTWRITEBYTECODE": "1",
            "WARP_CACHE_PATH": str(cache),
            "OPENBLAS_NUM_THREADS": "1",
        }
        code = "import ddg_warp, ddg_warp.kernels.terms as k, ddg_warp.scenes as s; print(ddg_warp.__file__, k.__file__, s.__path__[0])"
        imported = self.run(["-c", code]).stdout.split()
        if len(imported) != 3 or not all(Path(path).resolve().is_relative_to(self.root.resolve()) for path in imported):
            raise RuntimeError(f"the copy in {self.root} does not import itself: {imported}")

    def run(self, arguments: list[str], limit: float = TIME_LIMIT) -> subprocess.CompletedProcess:
        """Run Python with arguments in the copy, for at most `limit` [s]."""
        options = {"cwd": self.root, "env": self.environment, "capture_output": True, "text": True}
        return subprocess.run([sys.executable, *arguments], **options, check=False, timeout=limit)

    def failure(self, tests: str, limit: float = TIME_LIMIT) -> str:
        """Return the id of the first fast test that fails in a file, folder or id, or "" if all pass."""
        try:
            result = self.run(["-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", tests], limit)
        except subprocess.TimeoutExpired:
            return tests
        if result.returncode == 0:
            return ""
        summary = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", result.stdout, re.M)
        return summary[1] if summary else tests

    def found_by(self, fault: Fault, whole: bool) -> str:
        """Return the test, or the file without a finished test, that finds a fault; "NOT FOUND ..." without."""
        path = self.root / fault.file
        sound = path.read_text()
        path.write_text(sound.replace(fault.old, fault.new))
        try:
            test = next(filter(None, map(self.failure, fault.tests)), "")
            if not test and whole:
                test = self.failure("tests", WHOLE_LIMIT)
        finally:
            path.write_text(sound)
        if test and self.failure(test, WHOLE_LIMIT):
            return f"{MISSED}: {test} fails without it, too"
        return test or MISSED


def _link(source: str, target: str) -> None:
    """Link a file, which Warp never writes in place; copy it from another file system."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="faults with this text in their name or file (default: all)"
    )
    parser.add_argument("--list", action="store_true", help="print the faults")
    parser.add_argument(
        "--whole", action="store_true", help="run all fast tests if the files of a fault do not find it"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write mutants.csv and .json to this folder")
    arguments = parser.parse_args()
    wanted = [f for f in FAULTS if not arguments.names or any(name in f.name + f.file for name in arguments.names)]
    if not wanted:
        parser.error(f"no fault is named {' or '.join(arguments.names)}; --list prints all")
    for fault in wanted:
        fault.check(ROOT)
    if arguments.list:
        print(table([{"fault": fault.name, "file": fault.file, "tests": " ".join(fault.tests)} for fault in wanted]))
        return 0
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for fault in wanted:
            start = time.perf_counter()
            test = copy.found_by(fault, arguments.whole)
            seconds = round(time.perf_counter() - start, 1)
            rows.append({"fault": fault.name, "file": fault.file, "found by": test, "seconds": seconds})
            print(f"{seconds:6.1f} s  {fault.name}: {test}", flush=True)
    print(table(rows))
    missed = sum(row["found by"].startswith(MISSED) for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} faults found")
    if arguments.out:
        origin = {"command": f"python {' '.join(['tools/mutants.py', *sys.argv[1:]])}", "machine": machine()}
        write_table(arguments.out / "mutants", rows, origin)
    return int(missed > MAX_MISSED)


if __name__ == "__main__":
    sys.exit(main())
