"""Shared by all packages: errors, files, records, options, the machine, progress."""
