"""One file a category: `build(rng)` draws an object in any size; `build_scene` fits it."""
