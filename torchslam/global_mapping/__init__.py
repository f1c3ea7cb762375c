"""Global mapping of a recording: every image against every image that sees the same, in no order of time.

images -> pairs (neighbors in time, similar places) -> matches, verified by two-view geometry -> view graph
       -> rotations -> tracks -> positions of cameras and points -> rounds of bundle adjustment and filtering
       -> map -> the other frames -> check by held-out image pairs

Source: Pan, Baráth, Pollefeys and Schönberger, "Global structure-from-motion revisited", ECCV 2024.
"""
