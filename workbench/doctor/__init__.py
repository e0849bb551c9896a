"""What is wrong with a rig, before an hour is lost: checks that change nothing, each with the way to mend it."""
