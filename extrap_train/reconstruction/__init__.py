"""From a few posed photographs to a full turn: views are added one at a time (paper II-C).

`global_map` holds what is known, `planner` says where the next view is made, `new_view` gives it
depth, `completion` runs the loop, `cloud` reads the points off. Nothing that is known is ever
estimated again.
"""
