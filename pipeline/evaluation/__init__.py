"""What a policy is worth: sampled, exact, and cell by cell."""
