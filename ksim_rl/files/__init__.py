"""Opens every file that a command reads, and writes every file that a command leaves."""
