"""Tables of results: what is measured how often stands in a YAML file, and one command runs it and writes the table."""
