"""Where the robot is: its pose from matches and a map."""
