"""Judges a policy under conditions that it may meet on a robot, the same for all policies, and writes a card of it."""
