"""Every Warp kernel of ddg_warp. Read `measures/edge_stretch.py`, then `element_path.py`, then `solve/sweep.py`."""

import logging
import os
import sys
import tempfile
import time

import warp as wp

if __name__ != "ddg_warp.kernels":
    raise ImportError("import ddg_warp.kernels, not kernels: install the package with `pip install -e .`")

if not os.environ.get("DDG_WARP_VERBOSE") and wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING  # scripts print their own output, no module loads

SILENT = 2.0  # time of compilation without a notice [s]
NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Start Warp without the warning of a missing CUDA driver; a request for CUDA is refused by name."""
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as output:
        os.dup2(output.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            output.seek(0)
            lines = output.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if NO_DRIVER not in line))


def announce_compilation(build_module) -> None:
    """Have the compiler of kernels write one notice, once it has taken longer than `SILENT`."""
    spent, announced = 0.0, False

    def announcing(build):
        def timed(*arguments, **options):
            nonlocal spent, announced
            if spent > SILENT and not announced:
                announced = True
                logging.getLogger("ddg_warp").warning(
                    "ddg_warp: kernels compile for the first time, a minute or two; later runs load them from %s",
                    wp.config.kernel_cache_dir,
                )
            began = time.monotonic()
            try:
                return build(*arguments, **options)
            finally:
                spent += time.monotonic() - began

        return timed

    for name in ("build_cpu", "build_cuda"):
        if hasattr(build_module, name):
            setattr(build_module, name, announcing(getattr(build_module, name)))


start_warp()
announce_compilation(wp._src.build)
