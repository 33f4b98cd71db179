"""Every Warp kernel of ddg_warp. Read `measures/edge_stretch.py`, then `element_path.py`, then `solve/sweep.py`."""

import os

import warp as wp

if __name__ != "ddg_warp.kernels":
    raise ImportError("import ddg_warp.kernels, not kernels: install the package with `pip install -e .`")

if not os.environ.get("DDG_WARP_VERBOSE") and wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING  # scripts print their own output, no module loads
