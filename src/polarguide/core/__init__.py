"""Code that all packages share: errors, files, records, options, system calls and progress."""
