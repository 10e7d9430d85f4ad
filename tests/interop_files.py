#!/usr/bin/env python3
"""We read others' files as they do: the test files of nibabel and pydicom, and every documented variant of MetaImage
and NRRD, voxel by voxel and place by place.

    PALPATE=target/debug/palpate python tests/interop_files.py

needs numpy, nibabel, pydicom and SimpleITK. Each file is read, or refused with its name and a reason. What is read is
compared with nibabel (NIfTI, Siemens mosaics), with pydicom's numbers (slices) or with SimpleITK (all others).
"""
import glob, gzip, itertools, os, shutil, subprocess, sys, tempfile
import nibabel as nib, numpy as np, pydicom, SimpleITK as sitk
from nibabel.nicom import dicomwrappers

PALPATE = os.path.abspath(os.environ.get("PALPATE", "target/debug/palpate"))
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
PLACE = 1e-3  # mm, at a corner of the volume


def read(path):
    """Values and affine (RAS), or the reason why it is refused."""
    with tempfile.TemporaryDirectory() as folder:
        out = os.path.join(folder, "out.nii")
        arguments = ["warp", path, "--reference", path, "--interpolation", "nearest", "-o", out, "--quiet"]
        run = subprocess.run([PALPATE, *arguments], capture_output=True, text=True)
        assert "panicked" not in run.stderr and run.returncode in (0, 1), (path, run.returncode, run.stderr)
        if run.returncode:
            assert os.path.basename(path) in run.stderr or os.path.dirname(path) in run.stderr, run.stderr
            return None, run.stderr.strip()
        image = nib.load(out)
        return np.asarray(image.dataobj).astype(float), image.affine


def same(path, values, affine):
    """The file at `path` is read as these values (x, y, z) at these places (RAS)."""
    found, placed = read(path)
    assert found is not None, placed
    values = np.asarray(values, float)
    values = values.reshape(values.shape + (1,) * (3 - values.ndim))[..., :]
    assert found.shape == values.shape[:3], (path, found.shape, values.shape)
    # Nearest neighbour leaves float32.
    wanted = values.reshape(found.shape).astype(np.float32)
    assert np.array_equal(found.astype(np.float32), wanted, equal_nan=True), (path, np.abs(found - wanted).max())
    corners = np.array(list(itertools.product(*[(0, n - 1) for n in found.shape])))
    apart = np.abs(nib.affines.apply_affine(placed, corners) - nib.affines.apply_affine(affine, corners)).max()
    assert apart < PLACE, (path, apart)


def tally(kind, done, refused):
    print(f"{kind}: {len(done)} read as by others, {len(refused)} refused")
    for path, why in refused:
        print("   ", os.path.basename(path), "-", why.split(": ", 2)[-1][:110])


def nibabel_files():
    folder = os.path.join(os.path.dirname(nib.__file__), "tests", "data")
    done, refused = [], []
    with tempfile.TemporaryDirectory() as own:
        for name in sorted(glob.glob(os.path.join(folder, "*"))):
            if not name.endswith((".nii", ".nii.gz", ".hdr", ".img")):
                continue
            # Headers alone, where nibabel has them so.
            try:
                image = nib.load(name)
                values = image.get_fdata()
            except Exception:
                refused.append((name, read(name)[1]))
                continue
            if values.ndim != 3:
                refused.append((name, read(name)[1]))
                continue
            same(name, values, image.affine)
            done.append(name)
            # The same as a pair, plain and packed, in either version and byte order.
            whole = np.asanyarray(image.dataobj)
            for number, (kind, ending) in enumerate([(nib.Nifti1Pair, ".img"), (nib.Nifti2Pair, ".hdr"), (nib.Nifti1Pair, ".img.gz"), (nib.Spm99AnalyzeImage, ".img")]):
                path = os.path.join(own, f"{number}{ending}")
                if kind is nib.Spm99AnalyzeImage:
                    kind(whole.astype(np.float32), image.affine).to_filename(path)
                    refused.append((path, read(path)[1]))
                    assert "ANALYZE" in refused[-1][1]
                    continue
                for endian in "<>":
                    header = kind.header_class(endianness=endian)
                    pair = kind(whole, image.affine, header)
                    pair.header.set_data_dtype(np.float32)
                    pair.set_data_dtype(np.float32)
                    pair.to_filename(path)
                    again = nib.load(path)
                    for one in (path, path.replace(".img", ".hdr") if ".img" in ending else path.replace(".hdr", ".img")):
                        same(one, again.get_fdata(), again.affine)
                        done.append(one)
    tally("nibabel", done, refused)
    assert len(done) > 10


def of_slice(path):
    """Values (x, y, 1) and affine of a single slice, by pydicom."""
    data = pydicom.dcmread(path)
    values = data.pixel_array.astype(float) * float(data.get("RescaleSlope", 1)) + float(data.get("RescaleIntercept", 0))
    down, along = map(float, data.PixelSpacing)
    row, column = np.array(data.ImageOrientationPatient[:3], float), np.array(data.ImageOrientationPatient[3:], float)
    affine = np.eye(4)
    affine[:3, 0], affine[:3, 1], affine[:3, 2] = row * along, column * down, np.cross(row, column) * float(data.get("SliceThickness") or 1)
    affine[:3, 3] = np.array(data.ImagePositionPatient, float)
    return values.T[..., None], RAS @ affine


def pydicom_files():
    folder = os.path.join(os.path.dirname(pydicom.__file__), "data", "test_files")
    done, refused = [], []
    with tempfile.TemporaryDirectory() as own:
        for name in sorted(glob.glob(os.path.join(folder, "*.dcm"))):
            # Alone, so that no other file of the same series is beside it.
            path = os.path.join(own, os.path.basename(name))
            shutil.copy(name, path)
            found, why = read(path)
            if found is None:
                refused.append((name, why))
            else:
                same(path, *of_slice(path))
                done.append(name)
            os.remove(path)
    tally("pydicom", done, refused)
    names = {os.path.basename(n) for n in done}
    wanted = {"MR_small.dcm", "MR_small_RLE.dcm", "MR_small_bigendian.dcm", "MR_small_implicit.dcm", "MR_small_expb.dcm", "MR_small_padded.dcm", "CT_small.dcm"}
    assert wanted <= names, wanted - names
    said = {os.path.basename(n): why for n, why in refused}
    for name, syntax in [("MR_small_jp2klossless.dcm", "JPEG 2000"), ("MR_small_jpeg_ls_lossless.dcm", "JPEG-LS"), ("JPGExtended.dcm", "12 bits")]:
        assert syntax in said[name], said[name]


def mosaics():
    folder = os.path.join(os.path.dirname(nib.__file__), "nicom", "tests", "data")
    with tempfile.TemporaryDirectory() as own:
        for name in ("siemens_dwi_0.dcm.gz", "siemens_dwi_1000.dcm.gz"):
            path = os.path.join(own, name[:-3])
            with gzip.open(os.path.join(folder, name)) as packed, open(path, "wb") as plain:
                plain.write(packed.read())
            wrapper = dicomwrappers.wrapper_from_file(path)
            # nibabel has rows before columns.
            swap = np.eye(4)[[1, 0, 2, 3]]
            same(path, np.transpose(wrapper.get_data(), (1, 0, 2)), RAS @ wrapper.affine @ swap)
    print("Siemens mosaics: as nibabel has them")


def written_by_itk():
    """Series of slices that ITK writes, plain and in JPEG lossless."""
    rng = np.random.default_rng(3)
    voxels = rng.integers(-500, 3000, (4, 12, 17)).astype(np.int16)
    for compressor in (None, "JPEG"):
        with tempfile.TemporaryDirectory() as own:
            writer = sitk.ImageFileWriter()
            writer.SetImageIO("GDCMImageIO")
            writer.KeepOriginalImageUIDOn()
            if compressor:
                writer.UseCompressionOn()
                writer.SetCompressor(compressor)
            for k, plane in enumerate(voxels):
                image = sitk.GetImageFromArray(plane[None])
                image.SetSpacing([2.0, 3.0, 4.0])
                image.SetOrigin([10.0, -20.0, 30.0 + 4 * k])
                for key, value in {
                    "0020|000e": "1.2.3.4", "0020|000d": "1.2.3", "0008|0018": f"1.2.3.4.{k + 1}", "0008|0060": "MR",
                    "0020|0032": f"10\\-20\\{30 + 4 * k}", "0020|0037": "1\\0\\0\\0\\1\\0", "0020|0013": str(k), "0018|0050": "4",
                }.items():
                    image.SetMetaData(key, value)
                writer.SetFileName(os.path.join(own, f"{k}.dcm"))
                writer.Execute(image)
            syntax = str(pydicom.dcmread(os.path.join(own, "0.dcm")).file_meta.TransferSyntaxUID)
            affine = np.diag([2.0, 3.0, 4.0, 1.0])
            affine[:3, 3] = [10, -20, 30]
            same(own, np.transpose(voxels), RAS @ affine)
            same(os.path.join(own, "2.dcm"), np.transpose(voxels), RAS @ affine)
            print("series by ITK in", syntax, "read as written")


def by_itk(path):
    image = sitk.ReadImage(path)
    values = np.transpose(sitk.GetArrayFromImage(image))
    affine = np.eye(4)
    n = image.GetDimension()
    affine[:n, :n] = np.array(image.GetDirection()).reshape(n, n) * np.array(image.GetSpacing())
    affine[:n, 3] = image.GetOrigin()
    return (values[..., None] if n == 2 else values), RAS @ affine


def rewritten(folder, names, spacing):
    """Volumes that ITK writes under these names, plain and packed, are read as ITK reads them; returns how many."""
    cases = list(itertools.product((sitk.sitkInt16, sitk.sitkFloat32), names, (False, True)))
    for kind, name, packed in cases:
        image = sitk.Cast(sitk.GetImageFromArray(np.arange(24, dtype=np.int16).reshape(2, 3, 4)), kind)
        image.SetSpacing(spacing)
        path = os.path.join(folder, name)
        sitk.WriteImage(image, path, packed)
        same(path, *by_itk(path))
    return len(cases)


def metaimage():
    """What the documentation of MetaIO lists: types, byte orders, names of the places, packed, beside, in two dimensions."""
    types = {"MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
             "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
    turned = "0 1 0 -1 0 0 0 0 1"
    places = ["", "ElementSpacing = 2 3 4\n", "ElementSize = 2 3 4\n", "ElementSize = 9 9 9\nElementSpacing = 2 3 4\n", "Offset = 1 2 3\n", "Position = 1 2 3\n",
              "Origin = 1 2 3\n", "Position = 9 9 9\nOffset = 1 2 3\n", "Offset = 9 9 9\nOrigin = 1 2 3\n", f"TransformMatrix = {turned}\n", f"Rotation = {turned}\n",
              f"Orientation = {turned}\n", f"TransformMatrix = {turned}\nOffset = 1 2 3\nElementSpacing = 2 3 4\nCenterOfRotation = 0 0 0\n",
              "AnatomicalOrientation = RAI\n", "Comment = a = b\n", "ElementSpacing = 2 3 4\nElementSpacing = 5 6 7\n"]
    count = 0
    with tempfile.TemporaryDirectory() as own:
        def case(head, body, name="a.mha", beside=None):
            nonlocal count
            path = os.path.join(own, name)
            with open(path, "wb") as f:
                f.write(head.encode() + (b"" if beside else body))
            if beside:
                with open(os.path.join(own, beside), "wb") as f:
                    f.write(body)
            same(path, *by_itk(path))
            count += 1
        start = "ObjectType = Image\nNDims = 3\nBinaryData = True\n"
        for kind, code in types.items():
            for big in (False, True):
                voxels = (np.arange(24) * 5).astype((">" if big else "<") + code)
                head = f"{start}BinaryDataByteOrderMSB = {big}\nDimSize = 4 3 2\nElementType = {kind}\n"
                case(head + "ElementDataFile = LOCAL\n", voxels.tobytes())
                case(head + "ElementDataFile = a.raw\n", voxels.tobytes(), "a.mhd", "a.raw")
                case(head + "HeaderSize = 7\nElementDataFile = a.raw\n", b"skipped" + voxels.tobytes(), "a.mhd", "a.raw")
                case(head + "HeaderSize = -1\nElementDataFile = a.raw\n", b"skipped" + voxels.tobytes(), "a.mhd", "a.raw")
        voxels = np.arange(24).astype("<i2").tobytes()
        for place in places:
            case(f"{start}{place}DimSize = 4 3 2\nElementType = MET_SHORT\nElementDataFile = LOCAL\n", voxels)
        case("NDims = 2\nElementSpacing = 2 3\nOffset = 1 2\nDimSize = 4 6\nElementType = MET_SHORT\nElementDataFile = LOCAL\n", voxels)
        count += rewritten(own, ("b.mha", "b.mhd"), [1, 1, 1])
    print(f"MetaImage: {count} variants as ITK reads them")


def nrrd():
    """What teem documents of types, spaces, encodings and files apart, where ITK reads it."""
    types = {"signed char": "i1", "int8": "i1", "uchar": "u1", "uint8_t": "u1", "short": "i2", "signed short int": "i2", "ushort": "u2", "int": "i4", "int32": "i4",
             "unsigned int": "u4", "longlong": "i8", "uint64": "u8", "float": "f4", "double": "f8"}
    spaces = ["left-posterior-superior", "LPS", "right-anterior-superior", "RAS", "left-anterior-superior", "LAS"]
    count = 0
    with tempfile.TemporaryDirectory() as own:
        def case(head, body, name="a.nrrd", beside=None):
            nonlocal count
            path = os.path.join(own, name)
            with open(path, "wb") as f:
                f.write(head.encode() + (b"" if beside else b"\n" + body))
            if beside:
                with open(os.path.join(own, beside), "wb") as f:
                    f.write(body)
            same(path, *by_itk(path))
            count += 1
        place = "space directions: (2,0,0) (0,0,3) (0,-4,0)\nspace origin: (1,2,3)\nkinds: domain domain domain\n"
        for kind, code in types.items():
            for endian in ("little", "big"):
                voxels = (np.arange(24) * 5).astype((">" if endian == "big" else "<") + code).tobytes()
                head = f"NRRD0004\n# comment\ntype: {kind}\ndimension: 3\nspace: LPS\nsizes: 4 3 2\n{place}endian: {endian}\nkey:=value\n"
                case(head + "encoding: raw\n", voxels)
                case(head + "encoding: gzip\n", gzip.compress(voxels))
                case(head + "encoding: raw\ndata file: a.raw\n", voxels, "a.nhdr", "a.raw")
                case(head + "encoding: raw\nbyte skip: 5\ndata file: a.raw\n", b"12345" + voxels, "a.nhdr", "a.raw")
                case(head + "encoding: raw\nbyte skip: -1\ndata file: a.raw\n", b"12345" + voxels, "a.nhdr", "a.raw")
        voxels = np.arange(24).astype("<i2").tobytes()
        for magic, space in itertools.product(("NRRD0001", "NRRD0004", "NRRD0005"), spaces):
            case(f"{magic}\ntype: short\ndimension: 3\nspace: {space}\nsizes: 4 3 2\n{place}endian: little\nencoding: raw\n", voxels)
        case("NRRD0001\ntype: short\ndimension: 3\nsizes: 4 3 2\nspacings: 2 3 4\nendian: little\nencoding: raw\n", voxels)
        count += rewritten(own, ("b.nrrd", "b.nhdr"), [2, 3, 4])
    print(f"NRRD: {count} variants as ITK reads them")


def main():
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    nibabel_files()
    pydicom_files()
    mosaics()
    written_by_itk()
    metaimage()
    nrrd()


if __name__ == "__main__":
    sys.exit(main())
