"""Suites of benchmark tasks of other packages, on those packages' own models, one folder each."""
