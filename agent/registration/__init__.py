"""From nothing: who is where, when no initial pose and no identity is known."""
