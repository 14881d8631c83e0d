"""Physics, sensing and simulated time: all that a real flight would bring by itself."""
