"""What a run came to: displayed quality, the files of a run, the contact sheet."""
