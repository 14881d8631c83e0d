"""What the agent asks its autopilot to do."""
