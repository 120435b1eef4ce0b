"""Each fault that can befall a run is provoked, and what it did is compared with what it may do."""
