"""The quality of a video, and the pages that show it: pure functions from arrays to numbers and pictures.

::

    video, truth --> metrics   PSNR, SSIM                   --+
    video, masks --> curves    sinusoids in a region          +--> result    DemoResult
    facts of the run -----------------------------------------+       |
                                                                      +--> summary             --+
                                                                      +--> figures, animation  --+--> report

    runs of every solver --> tradeoff  accuracy, time  --> knees, tradeoff_figures --> tradeoff_page
        on each of       cases     recordings and procedural scenes
    a calibration        --> calibration_page
    scenes of the paper  --> paper     its figures     --> paper.page
    videos on disk       --> rendering movies, sheets, video_page with error_map

    shared by the pages: page (templates), themed (drawings), player (videos), host (load of the machine)

Nothing here opens a device or a socket. Only reports, pages and renderings write files; ``paper`` also makes
the recordings that it needs.
"""

from acquire.scratch import prepare_matplotlib

prepare_matplotlib()
