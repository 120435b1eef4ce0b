"""Robots follow reference motions with their whole body here: terms, tasks, and trials that count successes."""
