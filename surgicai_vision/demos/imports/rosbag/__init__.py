"""ROS bags: read without ROS, resampled, segmented and replayed in this scene."""
