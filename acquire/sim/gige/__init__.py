"""A simulated GigE Vision camera: real packets on the loopback interface, lines from the forward model."""
