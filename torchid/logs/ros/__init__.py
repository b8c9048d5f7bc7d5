"""Logs from bags of ROS 1 and ROS 2: messages of several topics, brought to the stamps of one."""
