"""What mappo-player is made of: its options, the executable it writes, the log it keeps."""
