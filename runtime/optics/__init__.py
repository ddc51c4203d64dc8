"""Display optics, implemented as pure functions of arrays.

Names and docstrings state the frame and unit of each quantity, and the equation that a function implements. Unless a
docstring says otherwise:

* `eye_m` (3,) and `eyes_m` (V, 3) are positions in frame `stack`: the first viewer's left and right eye, then the next
  viewer's. `solved_for_m` are the eyes that layers were solved for.
* `layers` are (N, H, W, 3 or 4) 8-bit codes as the panels receive them, rear to front. A fourth channel is ignored.
* Pictures and targets are (h, w, 3) codes, or intensities in [0, 1], in the eyes' order. Masks are (h, w).
* `fov_deg` is a picture's horizontal field of view. Its eye looks at the stack's origin.
"""
