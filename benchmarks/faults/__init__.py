"""What happens when things go wrong: each fault is provoked, and what it did is compared with what it may do."""
