"""Tables of results: a YAML file lists the measurements, and one command runs it and writes the table."""
