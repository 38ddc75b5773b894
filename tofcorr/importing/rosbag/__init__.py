"""ROS bags: depth images and the robot's transforms, read one message at a time.

`bag` opens a bag and finds topics, `messages` gives access to the messages of a topic by number,
`image_message` decodes them, `tf_tree` follows the transforms from base to tool, and `source` puts
them together.
"""
