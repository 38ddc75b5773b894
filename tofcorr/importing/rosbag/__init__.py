"""ROS bags: depth images and the robot's transforms, read one message at a time.

`bag` gives access to the messages of a topic by number and decodes images, `tf_tree` follows the
transforms from base to tool, and `source` puts them together.
"""
