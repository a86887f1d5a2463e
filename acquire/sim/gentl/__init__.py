"""A simulated GenTL producer: cameras for any GenICam program, with lines from the forward model."""
