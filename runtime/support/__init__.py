"""What every part may use: files that are whole or not there, background jobs, GL contexts, logs."""
