"""A simulated GenTL producer: cameras for any GenICam program, fed by the forward model."""
