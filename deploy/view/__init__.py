"""A run in three dimensions: live, from its recording, or as a file for other viewers."""
