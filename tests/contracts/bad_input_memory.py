"""Bad inputs to what is built: more worlds than memory or indices have room for."""

# fmt: off
from bad_inputs import each, held_rods, sheet

each("memory", "worlds", [2**31, 2**40, 2**61], lambda v: held_rods().build("cpu", worlds=v), f"count to {2**31 - 1}", "worlds at most")
each("memory", "worlds of rods", [2**26], lambda v: held_rods().build("cpu", worlds=v), f"worlds = {2**26}", "GiB at least", "left")
each("memory", "worlds of a sheet", [2**26], lambda v: sheet().build("cpu", worlds=v), f"worlds = {2**26}", "GiB at least", "left")
