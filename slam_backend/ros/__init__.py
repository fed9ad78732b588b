"""The ROS 2 coat: the only folder that imports rclpy or message packages. It converts, calls, and converts back."""
