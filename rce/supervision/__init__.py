"""Child programs: started, watched, restarted, ended, whatever happens to the program that watches them."""
