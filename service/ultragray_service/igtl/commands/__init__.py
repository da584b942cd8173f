"""Commands of PLUS over OpenIGTLink: a client sets its scanner and asks how it is set."""
