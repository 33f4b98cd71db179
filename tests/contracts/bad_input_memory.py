"""Bad inputs to builds: more worlds than memory or indices allow."""

# fmt: off
from bad_inputs import clamped, each, sheet

each("memory", "worlds", [2**31, 2**40, 2**61], lambda v: clamped().build("cpu", worlds=v), f"count to {2**31 - 1}", "worlds at most")
each("memory", "worlds of rods", [2**26], lambda v: clamped().build("cpu", worlds=v), f"worlds = {2**26}", "GiB at least", "left")
each("memory", "worlds of a sheet", [2**26], lambda v: sheet().build("cpu", worlds=v), f"worlds = {2**26}", "GiB at least", "left")
