"""Real robots: Robotino and ROS 2 links, and what a driver may believe and send."""
