"""Reference motions are made here: by inverse kinematics over keyframes, or from recordings of people and robots."""
