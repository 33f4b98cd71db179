"""Every Warp kernel of ddg_warp. Read `measures/edge_stretch.py`, then `element.py`, then `chain.py`."""

if __name__ != "ddg_warp.kernels":
    raise ImportError("import ddg_warp.kernels, not kernels: install the package with `pip install -e .`")
