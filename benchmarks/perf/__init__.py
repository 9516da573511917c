"""How fast our kernels are, against plain reference implementations timed in the same run.

One module a name, each with `run() -> list[Timing]`; `benchmark perf NAME` finds it by that name.
"""
