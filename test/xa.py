"""DICOM XA files, made here."""

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

SID, SOD, PITCH = 1000.0, 750.0, 0.5        # mm
PERSON = dict(PatientName='Secret^Somebody', PatientID='SECRET-0815', PatientBirthDate='19700102',
              InstitutionName='Secret Hospital',
              StudyDate='20260102', OperatorsName='Secret^Operator', StudyDescription='SECRET', ContentTime='121314')


def make(path, frames, primary=0.0, syntax=ExplicitVRLittleEndian, pixel_data=None, **attributes):
    """An XA file of (N, H, W) uint8 or uint16 frames; an attribute of None is left out. `path` may be an open file."""
    frames = np.asarray(frames)
    bits = 8 * frames.itemsize
    meta = FileMetaDataset()
    meta.TransferSyntaxUID, meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = (
        syntax, '1.2.840.10008.5.1.4.1.1.12.1', generate_uid(entropy_srcs=['xa']))
    header = Dataset()
    header.file_meta = meta
    given = dict(SOPClassUID=meta.MediaStorageSOPClassUID, SOPInstanceUID=meta.MediaStorageSOPInstanceUID,
                 Modality='XA', Rows=frames.shape[1], Columns=frames.shape[2], NumberOfFrames=len(frames),
                 SamplesPerPixel=1, PhotometricInterpretation='MONOCHROME2', BitsAllocated=bits,
                 BitsStored=bits, HighBit=bits - 1, PixelRepresentation=0, PixelIntensityRelationship='LIN',
                 DistanceSourceToDetector=SID, DistanceSourceToPatient=SOD, ImagerPixelSpacing=[PITCH, PITCH],
                 PositionerPrimaryAngle=primary, PositionerSecondaryAngle=0.0, FrameTime=100.0)
    for keyword, value in (PERSON | given | attributes).items():
        if value is not None:
            setattr(header, keyword, value)
    header.PixelData = pixel_data or frames.tobytes()
    header['PixelData'].VR = 'OB' if bits == 8 or pixel_data else 'OW'
    header.save_as(path, enforce_file_format=True)
    return path


def logarithms(descriptor=(256, 0, 16)):
    """The attributes of LOG pixels of 8 bits and of the table that makes intensities, their squares, of them."""
    table = Dataset()
    table.LUTDescriptor, table.ModalityLUTType, table.LUTData = list(descriptor), 'US', [k * k for k in range(256)]
    table['LUTData'].VR, table['LUTDescriptor'].VR = 'US', 'SS' if min(descriptor) < 0 else 'US'
    return dict(PixelIntensityRelationship='LOG', ModalityLUTSequence=[table])


CLASSIC = ('DistanceSourceToDetector', 'DistanceSourceToPatient', 'ImagerPixelSpacing', 'PositionerPrimaryAngle',
           'PositionerSecondaryAngle', 'FrameTime', 'PixelIntensityRelationship')


def item(**values):
    """A dataset; a dict for a value is a sequence of one item."""
    made = Dataset()
    for keyword, value in values.items():
        setattr(made, keyword, [item(**value)] if isinstance(value, dict) else value)
    return made


def enhanced(path, frames, angles, times=None, **attributes):
    """An Enhanced XA file: distances and spacing shared, the primary angle of each frame, and its time in s, in a
    functional group of its own."""
    shared = item(XRayGeometrySequence=dict(DistanceSourceToIsocenter=SOD, DistanceSourceToDetector=SID),
                  FramePixelDataPropertiesSequence=dict(ImagerPixelSpacing=[PITCH, PITCH],
                                                        PixelIntensityRelationship='LIN'))
    own = []
    for k, angle in enumerate(angles):
        content = (dict(FrameAcquisitionDateTime=f'20260102121314.{round(1e6 * times[k]):06d}')
                   if times else dict(StackID='1'))
        own.append(item(PositionerPositionSequence=dict(PositionerPrimaryAngle=angle, PositionerSecondaryAngle=0.0),
                        FrameContentSequence=content))
    return make(path, frames, SOPClassUID='1.2.840.10008.5.1.4.1.1.12.1.1', **dict.fromkeys(CLASSIC) | dict(
        SharedFunctionalGroupsSequence=[shared], PerFrameFunctionalGroupsSequence=own) | attributes)
