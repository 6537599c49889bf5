"""What leaves the studio: the chosen design as files that other tools read and that agree with each other."""
