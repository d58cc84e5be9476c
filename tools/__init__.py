"""What a checkout does beside the backend: the demo, the package."""
