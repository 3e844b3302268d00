"""What users write: client config files, engine settings, the shared secret; and where shipped files are."""
