"""A ROS 2 node that corrects time-of-flight depth images."""
