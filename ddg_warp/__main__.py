"""`python -m ddg_warp` is `ddg-warp`."""

from ddg_warp.run.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
