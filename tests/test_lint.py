"""Kernel lint: every fault is found at its position, and sound code passes; faults of the mutation check fit their files."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tools"))

import mutants  # noqa: E402
from lint_kernels import lint  # noqa: E402

HEAD = "import warp as wp\n\n"
PAIR = "@wp.func\ndef g(x: real):\n    return x, x\n\n"
FUNC = "@wp.func\ndef f(q: V, a: real):\n    "
GRAD = "\n    return q\nw = wp.grad(f)\n"
KERNEL, NO_ADJOINT = (
    f"@wp.kernel(module='unique', enable_backward={on}, module_options=O)\ndef k(q: V, a: real, out: wp.array(dtype=real)):\n    "
    for on in (True, False)
)

FAULTS = {
    "tuple returned": ("tuple-index", PAIR + FUNC + "t = g(a)\n    return t[0]\n"),
    "tuple indexed at once": ("tuple-index", PAIR + FUNC + "return g(a)[0]\n"),
    "tuple unpacked elsewhere": ("tuple-index", FUNC + "t = g(a)\n    c, d = g(a)\n    return t[1]\n"),
    "component from itself": ("self-overwrite", FUNC + "q[0] = q[0] * a" + GRAD),
    "component in a sum": ("self-overwrite", FUNC + "q[i] = a + wp.abs(q[i])" + GRAD),
    "component augmented": ("self-overwrite", KERNEL + "q[0] += a\n"),
    "array from itself": ("self-overwrite", KERNEL + "out[0] = out[0] * a\n"),
    "annotations": ("annotations", "from __future__ import annotations\n"),
    "kernel without keyword": ("enable-backward", "@wp.kernel(module_options=O)\ndef k(a: real):\n    pass\n"),
    "flags of Warp": ("cpu-options", "@wp.kernel(module='unique', enable_backward=False)\ndef k(a: real):\n    pass\n"),
    "literal in a product": ("float-literal", FUNC + "return 0.5 * a\n"),
    "literal as argument": ("float-literal", FUNC + "return wp.max(a, -1.0e-3)\n"),
    "static of a loop": (
        "static-variable",
        FUNC + "for i in range(3):\n        q[wp.static(3 * i)] = a\n    return q\n",
    ),
}

SOUND = {
    "unpacked": PAIR + FUNC + "c, d = g(a)\n    return c * d\n",
    "vector indexed": FUNC + "t = wp.normalize(q)\n    return t[0]\n",
    "other component": KERNEL + "q[0] = q[1] * a\n",
    "array added to": KERNEL + "out[0] += a\n",
    "no adjoint": NO_ADJOINT + "q[0] = q[0] * a\n    out[0] = out[0] * a\n",
    "called without adjoint": FUNC + "q[0] = q[0] * a\n    return q\n\n" + NO_ADJOINT + "p = f(q, a)\n",
    "static in a loop": FUNC + "for i in range(wp.static(n)):\n        q[wp.static(n) + i] = a\n    return q\n",
    "casts": FUNC + "return real(0.5) * a + linear(-1.0) + real(wp.static(0.25 * n))\n",
    "host code": "def host(x):\n    t = x, x\n    return 0.5 * t[0]\n",
}


def findings(tmp_path: Path, code: str):
    path = tmp_path / "sample.py"
    path.write_text(HEAD + code)
    return lint([path])


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_found(tmp_path, name):
    rule, code = FAULTS[name]
    assert [finding.rule for finding in findings(tmp_path, code)] == [rule]


@pytest.mark.parametrize("name", SOUND)
def test_sound_code_passes(tmp_path, name):
    assert findings(tmp_path, SOUND[name]) == []


def test_function_used_by_a_differentiated_file_is_differentiated(tmp_path):
    overwrite = HEAD + FUNC + "q[0] = q[0] * a\n    return q\n"
    (tmp_path / "measures").mkdir()
    (tmp_path / "frames.py").write_text(overwrite)
    (tmp_path / "pivot.py").write_text(overwrite)
    (tmp_path / "measures" / "stretch.py").write_text("from ddg_warp.kernels import frames\n")
    assert [finding.path.name for finding in lint([tmp_path])] == ["frames.py"]


def test_position_and_exit_code(tmp_path):
    path = tmp_path / "sample.py"
    path.write_text(HEAD + FAULTS["literal in a product"][1])
    command = [sys.executable, ROOT / "tools/lint_kernels.py", path]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stdout.startswith(f"{path}:5: float-literal:")


def test_kernels_of_the_package():
    assert lint([ROOT / "kernels"]) == []


def test_texts_of_the_mutation_check_occur_once():
    for fault in mutants.FAULTS:
        fault.check(ROOT)
        assert fault.new != fault.old
    assert len({fault.name for fault in mutants.FAULTS}) == len(mutants.FAULTS) == 35
