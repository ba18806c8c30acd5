"""The commands of `certify`, one file each, and what they share."""
