"""One file a category: `build(rng)` draws an object, as large as it comes; `build_scene` fits it."""
