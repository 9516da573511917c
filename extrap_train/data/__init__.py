"""Captures on disk to `FrameSequence`s, and prepared frames to the batches of training.

Everything read here comes from outside: paths never leave the data set's root, sizes are compared
before anything of that size is allocated, and what cannot be used raises `InputError` in one line.

| step | modules |
|---|---|
| a capture by what a person typed | `scene_spec` (`archives`) |
| its description | `co3d`, `uco3d`, `transforms_json` (`lens_keys`), `colmap`, `synthetic` |
| another program's | `polycam`, `record3d`, `metashape`, `realitycapture` (`photogrammetry`) |
| photographs and videos without one | `estimated_poses` (`picture_matches`), `keyframes` |
| to frames not yet read | `posed_entries`, `listed_photographs`, `listed_files`, `sequences` |
| files to pixels | `image_files`, `video_files`, `depth_files` (`lzfse_files`) |
| whether paths, text and cameras are sound | `paths`, `json_files`, `xml_files`, `camera_check` |
| photographs to squares with depth | `square_frames` |
| squares on disk and back | `frame_files` (`frame_codec`), `prepared` |
| a query and its references to a batch | `examples`, `module`; of one scene `scene_pairs` |
"""
