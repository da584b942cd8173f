"""The ROS 2 node of an UltraG-Ray service: probe poses go in, B-mode images come out.

ROS speaks metres, the service millimetres: `messages` converts, and nothing else does. `parameters` and
`newest` need no ROS; `node` needs rclpy and the standard messages, of a ROS 2 installation or of the extra `wheels`.
"""
