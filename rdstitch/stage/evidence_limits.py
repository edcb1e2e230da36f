"""Evidence that decides where tiles lie, in nats (logarithms of odds): a table of all thresholds.

An overlap whose pixels correlate by 0.6 has about 6 nats, one by 0.9 about 10: it counts for 24 independent pixels at
the most (:func:`rdstitch.stage.correlation.log_evidence`).
"""

import math

HUNDRED_TO_ONE = math.log(100.0)  # by which a place of a pair stands out against another, or against nothing
WRONG_PEAK = 6.0  # below which a pair is looked for elsewhere: a peak of about 0.6 may be one of a pattern
MIN_AXES_EVIDENCE = 10.0  # below which tiles show no other axes than told: one overlap that correlates by 0.9
ANYWHERE = math.log(1e-3)  # prior that a tile is anywhere but where its stage was sent, within its errors
