"""A simulated GigE Vision camera: real packets over the loopback interface, lines from the forward model."""
