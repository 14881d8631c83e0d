"""The seam: all that a driver, a simulator or another agent must know of an agent."""
