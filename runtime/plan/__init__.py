"""What may be left out: savings and their measurement, reuse, windows, quality levels and the time budget."""
