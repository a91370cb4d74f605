"""ROS 2 bags: `bag` opens files, `messages` makes rows of them, `reader` recordings."""
