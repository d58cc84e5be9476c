"""Files: video, images, HDF5, OpenVDB. Whole or absent, never half."""
