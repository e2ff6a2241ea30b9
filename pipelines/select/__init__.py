"""Selection: which frames reach the map, which become keyframes, and which keyframes a step optimises."""
