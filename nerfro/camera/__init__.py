"""What is believed of the training cameras: rays of a view -> rays."""
