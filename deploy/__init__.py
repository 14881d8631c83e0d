"""Launch, disturb, record and measure a swarm."""
