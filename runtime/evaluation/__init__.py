"""Results of a run or a solution: displayed quality, files, the contact sheet."""
