"""SURF, speeded-up robust features (Bay, Ess, Tuytelaars, Van Gool: CVIU 110, 2008), whose patents have expired.

No OpenCV wheel contains it. ``hessian`` finds blobs (§3 of the paper), ``refinement`` makes them accurate on patches
of the image, and ``descriptor`` turns (§4.1) and describes them (§4.2).
"""
