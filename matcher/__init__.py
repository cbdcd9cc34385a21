"""What the robot concludes: filters, matching, and its own position."""
