"""What every room needs: errors, files, records, options, the machine, progress."""
