"""The bodies of the commands, one file each: arguments, printing, exit statuses, and no mathematics."""
