"""Results of a run or a solution: displayed quality, files and the contact sheet."""
