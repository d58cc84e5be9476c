"""Makes the learned prior of backend/prior: random plumes from the solver of synthetic/, and the training on them."""
