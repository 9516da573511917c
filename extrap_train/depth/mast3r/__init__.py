"""MASt3R and DUSt3R: pairwise point maps from a transformer, for views with known cameras.

Leroy et al., Grounding Image Matching in 3D with MASt3R, ECCV 2024; Wang et al., DUSt3R: Geometric
3D Vision Made Easy, CVPR 2024. Names of modules are those of the published weights, which load
strictly; the weights are not part of this project and carry their own, non-commercial licence.
"""
