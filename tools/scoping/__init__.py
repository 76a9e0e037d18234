"""The live scope: the supervisor feeds a web server in a process of its own, which shows the run in a browser.

The two talk through one socket.  The supervisor never waits for it: what does not fit is dropped and counted.  So a
stalled browser, or a server that is slow or dead, costs the run nothing; the loop knows nothing of either.
"""
