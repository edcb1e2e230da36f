"""The Python of README, as it stands there; checked with everything else by mypy."""

import cv2
import numpy as np

import rdstitch

left = np.asarray(cv2.imread("left.jpg"))  # BGR like OpenCV; StitchOptions(channel_order="rgb")
result = rdstitch.pano([left, "right.jpg"])
cv2.imwrite("pano.png", result.image)  # result.alpha, result.verdict, result.registration, …
print(result)  # <StitchResult … pixels, 2 of 2 images, λ = …>

matches = result.registration.pairs[0].correspondences  # or points of your own: pixels, (N, 2), many of them wrong
fit = rdstitch.estimate_radial_homography(matches.points1, matches.points2, (1280, 960))
if fit:
    print(fit.distortion, fit.distortion_std, fit.model, fit.transfer(matches.points1[fit.inliers]))
else:
    print("no:", fit.reason)
