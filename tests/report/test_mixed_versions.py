"""A study whose runs were done with different versions says so."""

from report.page import write_report
from report.page.frame import Report
from report.series import study_series


def test_the_page_names_them(report_study, tmp_path):
    page = report_study.page.with_name("mixed.html")
    run = report_study.planned[0].run
    before = run.info_path.read_bytes()
    versions = run.read_info()["versions"]
    run.update_info(versions={**versions, "torch": "0.0<b>"})
    try:
        write_report(Report(study_series(report_study.analysis), "compare.py"), page)
        text = page.read_text()
    finally:
        run.info_path.write_bytes(before)
        page.unlink()
    n_others = len(report_study.planned) - 2
    assert (
        "Runs were done with different versions: torch "
        f"0.0&lt;b&gt; (1 run), {versions['torch']} ({n_others} runs)."
    ) in text
    assert "different versions" not in report_study.page.read_text()
