"""Files on disk: whole or not there, and the formats that no library reads for us."""
