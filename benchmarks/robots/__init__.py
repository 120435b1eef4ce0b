"""Real files of robots: what `ksim-rl robot`, `VelocityTask.for_robot` and a short training make of each."""
