"""What the agent makes of what it receives: own sensors, peers, and who they are."""
