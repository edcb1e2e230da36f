"""The Python of README, as it stands there; checked with everything else by mypy."""

import cv2
import numpy as np

import rdstitch

left = np.asarray(cv2.imread("left.jpg"))  # BGR, as OpenCV has it
result = rdstitch.pano([left, "right.jpg"])
cv2.imwrite("pano.png", result.image)  # result.alpha, result.verdict, result.registration, …
print(result)
