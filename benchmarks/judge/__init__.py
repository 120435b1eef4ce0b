"""Seeded random models that MuJoCo's C engine and the worlds of this package both step, and what differs.

`generator` writes a model as XML, `trial` judges it, `shrinking` makes one that fails small, and `hunt` judges many in
processes of their own. `python -m benchmarks.agreement --generated 400` is the command.
"""
