"""File formats: pictures, lens surfaces, archives, ray files and tables; reading is bounded, writing atomic."""
