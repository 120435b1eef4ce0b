"""Pages of docs/, and tables in them, that are made of code and results: `python -m benchmarks.pages` writes them."""
