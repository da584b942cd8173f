"""People and machines that an OpenID Connect issuer knows, by the tokens that it signs."""
