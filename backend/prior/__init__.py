"""What simulated plumes teach about smoke that one camera does not see: a network that proposes density and velocity."""
