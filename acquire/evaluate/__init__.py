"""How good a video is, and the report that shows it: pure functions from arrays to numbers and pictures.

::

    video, truth --> metrics   PSNR, SSIM                   --+
    video, masks --> curves    sinusoids in a region          +--> result    DemoResult
    facts of the run -----------------------------------------+       |
                                                                      +--> summary             --+
                                                                      +--> figures, animation  --+--> report

Nothing here opens a device, a recording or a socket; only ``report`` and what it calls write files.
"""
