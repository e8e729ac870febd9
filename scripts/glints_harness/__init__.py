"""Compares glint BSDFs with each other and with an independent reference, and times them.

A *method* is a name and a configuration of the BSDF that fills a scene's glint slot (`methods`). A *run* is a tuple
(scene, tiling, method, view, footprint rule, samples per pixel, seed); `render` carries it out. Every error is taken
against a reference that no filter and no data structure has touched (`reference`). Nothing in here knows the inside of
a method: plugins are known by name, scenes as XML files, results as images.
"""

import os

# FLIP's library starts a thread of OpenMP for each processor, and these wait for each other in busy loops: with all
# processors at work it would get ten times slower. It reads the variable when it is loaded, also in processes of pools.
os.environ.setdefault("OMP_NUM_THREADS", "1")
