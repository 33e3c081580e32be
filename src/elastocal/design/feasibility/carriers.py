"""What carries a body that no joint moves; i ≥ 0 stands for the frame of joint i."""

WORLD = -1  # fixed in the data's frame
HANGING = -2  # at the load point, axes parallel to the data's frame
