"""What a run was like, for who debugs it: kept for some minutes in memory, or written to a file all the way."""
