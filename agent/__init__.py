"""One MAV, one process: its sensing, its copy of the coupled estimator, its controller."""
