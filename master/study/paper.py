"""Published figures of the user study of Digits (Kim et al. 2012).

Twelve people made six poses in three blocks.

Only what its text gives as figures: PIP errors as ranges of means over the poses, and the repeatability of each
finger. The participants of the paper were shown their tracked hand while they posed (closed loop); ours are not.
"""

MEAN_LIMIT_DEG = 9.0  # every mean of finger and pose is below
MEAN_RANGE_DEG = {"index": (1.8, 2.9), "little": (3.8, 7.3)}
ICC = {"thumb": 0.74, "index": 0.88, "middle": 0.84, "ring": 0.81, "little": 0.66}
ICC_GOAL = 0.8  # ours, for every finger
PARTICIPANTS, BLOCKS = 12, 3
