"""Files as LabVIEW writes them."""

from __future__ import annotations

LVM_HEAD = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{decimal}
Multi_Headings\t{multi}
X_Columns\t{columns}
Time_Pref\tAbsolute
Operator\trig
Date\t2026/03/01
Time\t12:00:00{decimal}5
***End_of_Header***\t
\t
"""


def lvm_segment(a, b, *, columns, time, x0=0.0, step=0.002, samples=None, comment=""):
    """Return a segment of two channels, with points."""
    gap = "\t\t" if columns == "Multi" else "\t"
    pairs = {
        "Samples": len(a) if samples is None else samples,
        "Date": "2026/03/01",
        "Time": time,
        "Y_Unit_Label": "Volts",
        "X_Dimension": "Time",
        "X0": f"{x0:.16E}",
        "Delta_X": f"{step:.6f}",
    }
    lines = ["Channels\t2\t", *(f"{key}\t{value}{gap}{value}\t" for key, value in pairs.items())]
    second = "\tX_Value\t" if columns == "Multi" else "\t"
    lines += ["***End_of_Header***\t\t\t", f"X_Value\tVoltage_0{second}Voltage_1\tComment"]
    for i, (p, q) in enumerate(zip(a, b, strict=True)):
        x = f"{x0 + step * i:.6f}"
        middle = f"\t{x}\t" if columns == "Multi" else "\t"
        end = f"\t{comment}" if comment and i == 0 else ""
        lines.append(f"{'' if columns == 'No' else x}\t{p:.12f}{middle}{q:.12f}{end}")
    return "\n".join(lines) + "\n\n"


def written_lvm(path, segments, *, decimal=".", columns="One", multi="Yes"):
    body = "".join(segments)
    text = LVM_HEAD.format(decimal=decimal, columns=columns, multi=multi)
    path.write_bytes((text + (body.replace(".", ",") if decimal == "," else body)).encode("cp1252"))
    return path
