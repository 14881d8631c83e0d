"""One self-contained page about runs and studies: `swarm report`."""
