"""From a few posed photographs to a full turn: views are added one at a time (paper II-C).

`global_map` holds the views so far, `planner` chooses the next viewpoint, `new_view` gives its
picture depth, and `completion` runs the loop. Adding a view never changes earlier ones. Once all
views exist, `fusion` adjusts the generated depths; `cloud` and `mesh` extract the result.
"""
